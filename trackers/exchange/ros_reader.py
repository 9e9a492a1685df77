"""Messages of ROS 1 and ROS 2 bags, and of MCAP files, as columns of numbers and texts, by the package rosbags."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.expressions import sensor_of
from trackwright.trackers.exchange.mapping import Source, TableMapping, read_mapping, spelled_out
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.tables import TableFile

MESSAGES = Path(__file__).parent / "presets" / "_messages.toml"  # standard ones, by their type in place of a topic
LARGEST_BAG = 2**35  # bytes; only the messages of the topics asked for are held
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@contextmanager
def _told(what: str, fix: str = "record or copy it again") -> Iterator[None]:
    """Turns errors, of many kinds within rosbags, to UnusableInput."""
    try:
        yield
    except UnusableInput:
        raise
    except Exception as error:
        why = getattr(error, "strerror", None) or next(iter(str(error).splitlines()), type(error).__name__)
        raise UnusableInput(f"{what} ({why}); {fix}") from error


def read_bag(path: Path, mappings: Sequence[TableMapping]) -> Source:
    """The tables that the mappings make of a bag; raises UnusableInput with the topic and the number of the message."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        fix = "install the extra: pip install 'trackwright[ros]'"
        raise UnusableInput(f"{path}: ROS bags need the package rosbags; {fix}") from None
    source = Source()
    with ExitStack() as stack:
        with _told(f"{path}: cannot be read as a ROS bag"):
            files = [entry for entry in path.iterdir() if not entry.is_dir()] if path.is_dir() else [path]
            if sum(file.stat().st_size for file in files) > LARGEST_BAG:
                raise UnusableInput(f"{path}: holds more than {LARGEST_BAG / 1e9:.1f} GB; copy the topics needed")
            reader = stack.enter_context(AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
        known = sorted(reader.connections, key=lambda c: c.topic)
        for mapping in mappings:
            connections = [c for c in known if c.topic == mapping.topic]
            if not connections:
                topics = listed((f"{c.topic} ({c.msgtype}, {c.msgcount})" for c in known), 20)
                raise UnusableInput(f"{path}: no --topic {mapping.topic or ''} for {mapping.table}; topics: {topics}")
            source.read(*_columns(reader, path, mapping, connections))
    return source


def _columns(reader: Any, path: Path, mapping: TableMapping, connections: Any) -> tuple[TableFile, TableMapping]:
    """The fields of a topic's messages, as `header.stamp`, by a mapping, and it; a row for each element of lists."""
    topic, (kind, *others) = f"{path}: topic {mapping.topic}", sorted({c.msgtype for c in connections})
    if others:
        raise UnusableInput(f"{topic} has messages of {listed([kind, *others])}; expected one type")
    paths, wanted = list(_paths(reader.typestore.fielddefs, kind)), table_kinds()[mapping.table].layout(())
    fields, columns = listed(paths, 24), spelled_out(mapping.columns, paths)
    given = {sensor_of(target)[0] for target in columns}
    for one in read_mapping(MESSAGES):
        if one.topic == kind and one.table in (mapping.table, "truth" if mapping.table == "fixes" else ""):
            standard = {"t_s": "header.stamp", **spelled_out(one.columns, paths)}
            taken = {"t_s", *wanted.values, *wanted.optional} - given
            columns = {target: text for target, text in standard.items() if target in taken} | columns
    mapping = replace(mapping, columns=columns)
    if not mapping.sources():
        fix = f"map its fields, as --columns 'range_m=FIELD'; fields: {fields}"
        raise UnusableInput(f"{topic} has {kind}, no standard message for {mapping.table}; {fix}")
    rows: dict[str, list[Any]] = {source: [] for source in sorted(mapping.sources())}
    messages = reader.messages(connections=connections)
    for number in count(1):
        with _told(f"{topic}: the bag is broken"):
            record = next(messages, None)
        if record is None:
            break
        (connection, stamp, data), where = record, f"{topic}, message {number}"
        with _told(
            f"{where}: is no {kind}, or one that the bag does not define", "convert it to MCAP: ros2 bag convert"
        ):
            message = reader.deserialize(data, connection.msgtype)
        values = {source: _values(message, source, stamp, where, fields) for source in rows}
        sizes = {len(one) for one in values.values() if isinstance(one, list)}
        if len(sizes) > 1:
            raise UnusableInput(f"{where}: lists of lengths {sorted(sizes)} in {listed(rows)}; expected equal ones")
        for source, one in values.items():
            rows[source] += one if isinstance(one, list) else [one] * next(iter(sizes), 1)
    frame = pl.DataFrame({source: pl.Series(source, column) for source, column in rows.items()})
    if len(frame) > 1 and "header.stamp" in frame.columns and (frame["header.stamp"] == 0).all():
        raise UnusableInput(f"{topic}: header.stamp is 0 in every message; give t_s=received")
    return TableFile(Path(f"{path} {mapping.topic}"), frame), mapping


def _values(message: Any, source: str, stamp: int, where: str, fields: str) -> Any:
    """The value of a field, or of all elements in a list; times as seconds; `received`: when the bag received it."""
    if source == "received":
        return stamp / 1e9
    values = [message]
    try:
        for name, index in re.findall(r"(\w+)|\[(\d*)\]", source):
            if name:
                values = [getattr(value, name) for value in values]
            else:
                values = [value[int(index)] for value in values] if index else [one for each in values for one in each]
        plain = [v.sec + v.nanosec / 1e9 if hasattr(v, "nanosec") else v for v in values]
        plain = [v.item() if hasattr(v, "item") else v for v in plain]
    except (AttributeError, IndexError, ValueError):
        raise UnusableInput(f"{where}: no field {source}, as header.stamp or ranges[].id; fields: {fields}") from None
    return plain if "[]" in source else plain[0]


def _paths(definitions: Any, kind: str) -> Iterator[str]:
    """The paths of the fields of a message type; times and the elements of lists are single fields."""
    for name, (node, about) in definitions[kind][1] if kind in definitions else ():
        if node.name in ("ARRAY", "SEQUENCE"):
            name, (node, about) = name + "[]", about[0]
        if node.name == "NAME" and about not in _TIMES:
            yield from (f"{name}.{path}" for path in _paths(definitions, about))
        else:
            yield name
