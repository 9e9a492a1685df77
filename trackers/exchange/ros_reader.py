"""Messages of ROS 1 and ROS 2 bags, and of MCAP files, as columns of numbers and texts, by the package rosbags."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.mapping import Source, TableMapping, read_mapping
from trackwright.trackers.exchange.text_tables import parsed, sensor_of
from trackwright.trackers.recordings.files import file_bytes
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.tables import TableFile

MESSAGES = Path(__file__).parent / "presets" / "_messages.toml"  # standard ones, by their type in place of a topic


def read_bag(path: Path, mappings: Sequence[TableMapping]) -> Source:
    """The tables that the mappings make of a bag; raises UnusableInput with the topic and the number of the message."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UnusableInput(f"{path}: needs the package rosbags: pip install 'trackwright[ros]'") from None
    source = Source()
    try:
        for file in (entry for entry in (path.iterdir() if path.is_dir() else [path]) if not entry.is_dir()):
            file_bytes(file, 0)  # refuses pipes and devices
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for mapping in mappings:
                source.read(*_columns(reader, path, mapping))
    except UnusableInput:
        raise
    except Exception as error:  # of many kinds within rosbags
        why = getattr(error, "strerror", None) or next(iter(str(error).splitlines()), type(error).__name__)
        fix = "record it again, or convert it to MCAP: ros2 bag convert"
        raise UnusableInput(f"{path}: is broken, or no ROS bag that defines its messages ({why}); {fix}") from error
    return source


def _columns(reader: Any, path: Path, mapping: TableMapping) -> tuple[TableFile, TableMapping]:
    """The fields of a topic's messages, as `header.stamp`, by a mapping, and it; a row for each element of lists."""
    connections = [c for c in reader.connections if c.topic == mapping.topic]
    kinds = sorted({c.msgtype for c in connections})
    if len(kinds) != 1:
        known = listed(sorted(f"{c.topic} ({c.msgtype}, {c.msgcount})" for c in reader.connections), 20)
        found = f"--topic {mapping.topic or ''} for {mapping.table} has {listed(kinds) or 'no messages'}"
        raise UnusableInput(f"{path}: {found}; expected one type; topics: {known}")
    topic, wanted, columns = f"{path} {mapping.topic}", mapping.table, dict(mapping.columns)
    fields, kind = listed(name for name, _ in reader.typestore.fielddefs[kinds[0]][1]), table_kinds()[wanted].layout(())
    taken = {"t_s", *kind.values, *kind.optional} - {sensor_of(target)[0] for target in columns}
    for one in read_mapping(MESSAGES):
        if one.topic == kinds[0] and one.table in (wanted, "truth" if wanted == "fixes" else ""):
            standard = {"t_s": "header.stamp", **one.columns}
            columns = {target: text for target, text in standard.items() if target in taken} | columns
    mapping = replace(mapping, columns=columns)
    sources = sorted({*mapping.where, *(name for item in columns.items() for name in parsed(*item).sources)})
    if not sources:
        fix = f"map its fields, as --columns 'range_m=FIELD'; fields: {fields}"
        raise UnusableInput(f"{topic} has {kinds[0]}, no standard message for {wanted}; {fix}")
    rows: dict[str, list[Any]] = {source: [] for source in sources}
    for number, (connection, stamp, data) in enumerate(reader.messages(connections=connections), 1):
        message, where = reader.deserialize(data, connection.msgtype), f"{topic}, message {number}"
        values = {
            source: _values(message, source, stamp, f"{where}: no field {source}; fields: {fields}") for source in rows
        }
        sizes = {len(one) for one in values.values() if isinstance(one, list)}
        if len(sizes) > 1:
            raise UnusableInput(f"{where}: lists of lengths {sorted(sizes)} in {listed(rows)}; expected equal ones")
        for source, one in values.items():
            rows[source] += one if isinstance(one, list) else [one] * next(iter(sizes), 1)
    frame = pl.DataFrame({source: pl.Series(source, column) for source, column in rows.items()})
    if len(frame) > 1 and "header.stamp" in frame.columns and (frame["header.stamp"] == 0).all():
        raise UnusableInput(f"{topic}: header.stamp is 0 in every message; give t_s=received")
    return TableFile(Path(topic), frame), mapping


def _values(message: Any, source: str, stamp: int, lacking: str) -> Any:
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
        plain = [
            v.sec + v.nanosec / 1e9 if hasattr(v, "nanosec") else getattr(v, "item", lambda v=v: v)() for v in values
        ]
    except (AttributeError, IndexError, ValueError):
        raise UnusableInput(lacking) from None
    return plain if "[]" in source else plain[0]
