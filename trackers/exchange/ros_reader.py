"""Messages of ROS 1 and ROS 2 bags, and of MCAP files, as columns of numbers and texts, by the package rosbags."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.exchange.expressions import sensor_of
from trackwright.trackers.exchange.mapping import Asked, Source, TableMapping, spelled_out
from trackwright.trackers.recordings.input_file import LARGEST, file_bytes, size_of
from trackwright.trackers.recordings.kinds import layout, table_kinds
from trackwright.trackers.recordings.table_file import TableFile

RECEIVED = "received"
"""Field of every message: the time, s, at which the bag received it."""

LARGEST_BAG = 2**35
"""Bytes of the largest bag: only the messages of the topics asked for are held, at most `LARGEST` bytes."""

_PART = re.compile(r"(\w+)((?:\[\d*\])*)")
_WHOLE = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_POSES = {
    "geometry_msgs/msg/PointStamped": ("point", None),
    "geometry_msgs/msg/PoseStamped": ("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/TransformStamped": ("transform.translation", "transform.rotation"),
    "nav_msgs/msg/Odometry": ("pose.pose.position", "pose.pose.orientation"),
}
_STANDARD = {
    ("sensor_msgs/msg/Imu", "imu"): {
        **{f"accel_{a}_mps2": f"linear_acceleration.{a}" for a in "xyz"},
        **{f"gyro_{a}_radps": f"angular_velocity.{a}" for a in "xyz"},
    },
    ("sensor_msgs/msg/Range", "ranges"): {"range_m": "range"},
    ("nav_msgs/msg/Odometry", "odometry"): {
        "speed_mps": "twist.twist.linear.x", "yaw_rate_radps": "twist.twist.angular.z",
    },
}  # fmt: skip
for _kind, (_position, _attitude) in _POSES.items():
    _fix = {f"{a}_m": f"{_position}.{a}" for a in "xyz"}
    _STANDARD[_kind, "fixes"] = _fix
    _STANDARD[_kind, "truth"] = _fix | ({f"q{a}": f"{_attitude}.{a}" for a in "wxyz"} if _attitude else {})


def rosbags_module(name: str, what: str) -> ModuleType:
    """The module `rosbags.NAME`; raises UnusableInput, which names the extra, where the package is missing."""
    try:
        return import_module(f"rosbags.{name}")
    except ImportError:
        fix = "install the extra: pip install 'trackwright[ros]'"
        raise UnusableInput(f"{what} needs the package rosbags; {fix}") from None


@contextmanager
def _opened(path: Path, definitions: Sequence[Path]) -> Iterator[Any]:
    """A reader of the bag; `definitions`: .msg files, PACKAGE/msg/NAME.msg, of types that the bag does not define.

    Raises UnusableInput without the package rosbags, and for a file that is no bag. What has no end or is too large is
    refused before any of it is read. The files of a ROS 2 bag lie in its folder, whatever its metadata.yaml says.
    """
    anyreader, typesys = (rosbags_module(name, str(path)) for name in ("highlevel", "typesys"))
    try:
        files = [entry for entry in path.iterdir() if not entry.is_dir()] if path.is_dir() else [path]
        size = sum(map(size_of, files))
    except OSError as error:
        raise UnusableInput(f"{error.filename}: cannot be read ({error.strerror}); check the path") from error
    if size > LARGEST_BAG:
        fix = "copy the topics that are needed to a bag of their own"
        raise UnusableInput(f"{path}: holds more than {LARGEST_BAG / 1e9:.1f} GB; {fix}")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for file in definitions:
        name = "/".join([*file.parts[-3:-1], file.stem])
        try:
            store.register(typesys.get_types_from_msg(file_bytes(file).decode("utf-8"), name))
        except (OSError, ValueError, RecursionError, typesys.TypesysError) as error:
            wrong = f"is no message definition: {_first_line(error)}; expected PACKAGE/msg/NAME.msg"
            raise UnusableInput(f"{file}: {wrong}") from error
    # A broken bag raises errors of many kinds within rosbags.
    try:
        reader = anyreader.AnyReader([path], default_typestore=store)
        reader.open()
    except Exception as error:
        raise UnusableInput(f"{path}: cannot be read as a ROS bag: {_first_line(error)}") from error
    try:
        yield reader
    finally:
        reader.close()


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _messages(reader: Any, connections: Sequence[Any], topic: str) -> Iterator[tuple[str, Any, int]]:
    """Of each message where it is, in words, its content, and its time in ns; raises UnusableInput where it is broken.

    Broken bags and messages raise errors of many kinds within rosbags.
    """
    raw, size = reader.messages(connections=connections), 0
    for number in count(1):
        try:
            record = next(raw, None)
        except Exception as error:
            raise UnusableInput(f"{topic}: the bag is broken: {_first_line(error)}; record or copy it again") from error
        if record is None:
            return
        connection, stamp, data = record
        size += len(data)
        if size > LARGEST:
            raise UnusableInput(f"{topic}: its messages hold more than {LARGEST / 1e9:.1f} GB; split the bag")
        where = f"{topic}, message {number}"
        try:
            message = reader.deserialize(data, connection.msgtype)
        except KeyError as error:
            name = str(error.args[0])
            fix = f"define it and all its parts: --messages {name}.msg"
            raise UnusableInput(f"{where}: the bag does not define the type {name}; {fix}") from error
        except Exception as error:
            wrong = f"is no {connection.msgtype} ({_first_line(error)}); record it again"
            raise UnusableInput(f"{where}: {wrong}") from error
        yield where, message, stamp


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables that the mappings make of a bag; raises UnusableInput with the topic and the number of the message."""
    source = Source()
    with _opened(path, asked.definitions) as reader:
        if not asked.mappings:
            expected = "--table, or a file of mappings: --mapping FILE.toml"
            raise UnusableInput(f"{path}: no table given; expected {expected}; topics: {_topics_of(reader)}")
        for mapping in asked.mappings:
            if mapping.topic is None:
                raise UnusableInput(f"{path}: no --topic for {mapping.table}; expected one of {_topics_of(reader)}")
            source.read(*_columns(reader, path, mapping))
    return source


def _topics_of(reader: Any) -> str:
    """The topics of a bag with their types and numbers of messages, for messages."""
    known = sorted(reader.connections, key=lambda c: c.topic)
    return listed((f"{c.topic} ({c.msgtype}, {c.msgcount})" for c in known), 20)


def _columns(reader: Any, path: Path, mapping: TableMapping) -> tuple[TableFile, TableMapping]:
    """The fields of a topic's messages that a mapping names, one row a message or list element, and that mapping.

    Standard messages (poses, odometry, transforms, points, IMU, ranges) need no expressions; those given go first. A
    field is a path such as `header.stamp` or `ranges[].distance`, with a row for each element of lists in `[]`.
    """
    topic = f"{path}: topic {mapping.topic}"
    connections = [c for c in reader.connections if c.topic == mapping.topic]
    if not connections:
        raise UnusableInput(f"{path}: no topic {mapping.topic}; found {_topics_of(reader)}")
    kind, *others = sorted({c.msgtype for c in connections})
    if others:
        raise UnusableInput(f"{topic} has messages of {listed([kind, *others])}; expected one type")
    standard = _STANDARD.get((kind, mapping.table), {})
    standard = {"t_s": "header.stamp", **standard} if standard else {}
    # A standard field gives way to the user's, and the id of a sensor in brackets to none.
    given = {sensor_of(target)[0] for target in mapping.columns}
    asked = spelled_out(mapping, list(_paths(reader.typestore.fielddefs, kind))).columns
    mapping = replace(mapping, columns={t: text for t, text in standard.items() if t not in given} | dict(asked))
    fields = listed(_paths(reader.typestore.fielddefs, kind), 24)
    if not any(e.constant is None for e in mapping.expressions.values()):
        wanted = layout(mapping.table, ())
        names = (*wanted.ids[1:], *(wanted.values or table_kinds()[mapping.table].least))
        example = " ".join(f"'{name}=FIELD'" for name in names)
        raise UnusableInput(
            f"{topic} has {kind}, which is no standard message for {mapping.table}; map its fields: --columns "
            f"{example}; fields: {fields}"
        )
    rows: dict[str, list[Any]] = {source: [] for source in sorted(mapping.sources)}
    for where, message, stamp in _messages(reader, connections, topic):
        values = {source: _values(message, source, stamp, where, fields) for source in rows}
        sizes = {len(one) for one in values.values() if isinstance(one, list)}
        if len(sizes) > 1:
            raise UnusableInput(f"{where}: lists of lengths {sorted(sizes)} in {listed(rows)}; expected equal ones")
        for source, one in values.items():
            rows[source] += one if isinstance(one, list) else [one] * next(iter(sizes), 1)
    for source, column in rows.items():
        wrong = next((value for value in column if not isinstance(value, (int, float, str))), None)
        if wrong is not None:
            what = f"field {source} is a {type(wrong).__name__}; expected a number, text or time in it"
            raise UnusableInput(f"{path}: {what}")
    frame = pl.DataFrame({source: pl.Series(source, column) for source, column in rows.items()})
    if frame.is_empty():
        raise UnusableInput(f"{topic}: no messages; expected at least one")
    if len(frame) > 1 and "header.stamp" in frame.columns and (frame["header.stamp"] == 0).all():
        raise UnusableInput(f"{topic}: header.stamp is 0 in every message; give t_s=received")
    return TableFile(Path(f"{path} {mapping.topic}"), frame), mapping


def _values(message: Any, source: str, stamp: int, where: str, fields: str) -> Any:
    """The value of a field, or of all elements in a list; times as seconds."""
    if source == RECEIVED:
        return stamp / 1e9
    values, several = [message], False
    for part in source.split("."):
        match = _PART.fullmatch(part)
        if match is None:
            raise UnusableInput(f"{where}: {source!r} is no field; expected a path such as header.stamp or ranges[].id")
        if not all(hasattr(value, match[1]) for value in values):
            raise UnusableInput(f"{where}: no field {source}; fields: {fields}")
        values = [getattr(value, match[1]) for value in values]
        for index in re.findall(r"\[(\d*)\]", match[2]):
            if index and any(int(index) >= len(value) for value in values):
                raise UnusableInput(f"{where}: {source}: has fewer than {int(index) + 1} elements")
            several |= not index
            values = [value[int(index)] for value in values] if index else [item for value in values for item in value]
    plain = [v.sec + v.nanosec / 1e9 if hasattr(v, "nanosec") else getattr(v, "item", lambda v=v: v)() for v in values]
    return plain if several else plain[0]


def _paths(definitions: Any, kind: str) -> Iterator[str]:
    """The paths of the fields of a message type; times and the elements of lists are single fields."""
    for name, (node, about) in definitions[kind][1] if kind in definitions else ():
        if node.name in ("ARRAY", "SEQUENCE"):
            name, (node, about) = name + "[]", about[0]
        if node.name == "NAME" and about not in _WHOLE:
            yield from (f"{name}.{path}" for path in _paths(definitions, about))
        else:
            yield name
