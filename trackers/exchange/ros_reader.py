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


def rosbags_module(name: str, what: str) -> ModuleType:
    """The module `rosbags.NAME`; raises UnusableInput, which names the extra, where the package is missing."""
    try:
        return import_module(f"rosbags.{name}")
    except ImportError:
        raise UnusableInput(
            f"{what} needs the package rosbags; install the extra: pip install 'trackwright[ros]'"
        ) from None


@contextmanager
def opened(path: Path, definitions: Sequence[Path] = ()) -> Iterator[Any]:
    """A reader of the bag; `definitions`: .msg files, PACKAGE/msg/NAME.msg, of types that the bag does not define.

    Raises UnusableInput without the package rosbags, and for a file that is no bag.
    """
    anyreader, typesys = (rosbags_module(name, str(path)) for name in ("highlevel", "typesys"))
    _check_files(path)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for file in definitions:
        name = "/".join([*file.parts[-3:-1], file.stem])
        try:
            store.register(typesys.get_types_from_msg(file_bytes(file).decode("utf-8"), name))
        except (OSError, ValueError, RecursionError, typesys.TypesysError) as error:
            raise UnusableInput(
                f"{file}: is no message definition: {_first_line(error)}; expected PACKAGE/msg/NAME.msg"
            ) from error
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


def _check_files(path: Path) -> None:
    """Refuses what has no end and what is too large, before any of it is read.

    The files of a ROS 2 bag lie in its folder, whatever paths its metadata.yaml has.
    """
    try:
        files = [entry for entry in path.iterdir() if not entry.is_dir()] if path.is_dir() else [path]
        size = sum(map(size_of, files))
    except OSError as error:
        raise UnusableInput(f"{error.filename}: cannot be read ({error.strerror}); check the path") from error
    if size > LARGEST_BAG:
        raise UnusableInput(
            f"{path}: holds more than {LARGEST_BAG / 1e9:.1f} GB; copy the topics that are needed to a bag of their own"
        )


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
            raise UnusableInput(
                f"{where}: the bag does not define the type {name}; give its definition, as those of all its parts: "
                f"--messages {name}.msg"
            ) from error
        except Exception as error:
            raise UnusableInput(
                f"{where}: is no {connection.msgtype} ({_first_line(error)}); record it again"
            ) from error
        yield where, message, stamp


def read_source(path: Path, name: str, asked: Asked) -> Source:
    """The tables that the mappings make of a bag; raises UnusableInput with the topic and the number of the message."""
    source = Source()
    with opened(path, asked.definitions) as reader:
        if not asked.mappings:
            expected = "--table, or a file of mappings: --mapping FILE.toml"
            raise UnusableInput(f"{path}: no table given; expected {expected}; topics: {topics_of(reader)}")
        for mapping in asked.mappings:
            if mapping.topic is None:
                raise UnusableInput(f"{path}: no --topic for {mapping.table}; expected one of {topics_of(reader)}")
            source.read(*message_columns(reader, path, mapping))
    return source


def topics_of(reader: Any) -> str:
    """The topics of a bag with their types and numbers of messages, for messages."""
    return listed(
        (f"{c.topic} ({c.msgtype}, {c.msgcount})" for c in sorted(reader.connections, key=lambda c: c.topic)), 20
    )


def message_columns(reader: Any, path: Path, mapping: TableMapping) -> tuple[TableFile, TableMapping]:
    """The fields of a topic's messages that a mapping names, one row a message or list element, and that mapping.

    Standard messages (poses, odometry, transforms, points, IMU, ranges) need no expressions; those given go first. A
    field is a path such as `header.stamp` or `ranges[].distance`, with a row for each element of lists in `[]`.
    Raises UnusableInput with the topic and the number of the message.
    """
    connections = [c for c in reader.connections if c.topic == mapping.topic]
    if not connections:
        raise UnusableInput(f"{path}: no topic {mapping.topic}; found {topics_of(reader)}")
    kinds = sorted({c.msgtype for c in connections})
    if len(kinds) > 1:
        raise UnusableInput(f"{path}: topic {mapping.topic} has messages of {listed(kinds)}; expected one type")
    given = {sensor_of(target)[0] for target in mapping.columns}
    standard = _standard(kinds[0], mapping.table)
    # A standard field gives way to the user's, and the id of a sensor in brackets to none.
    asked = spelled_out(mapping, list(_paths(reader.typestore.fielddefs, kinds[0]))).columns
    columns = {target: text for target, text in standard.items() if target not in given} | dict(asked)
    mapping = replace(mapping, columns=columns)
    if not any(e.constant is None for e in mapping.expressions.values()):
        wanted = layout(mapping.table, ())
        names = (*wanted.ids[1:], *(wanted.values or table_kinds()[mapping.table].least))
        columns_of_table = " ".join(f"'{name}=FIELD'" for name in names)
        raise UnusableInput(
            f"{path}: topic {mapping.topic} has {kinds[0]}, which is no standard message for {mapping.table}; map its "
            f"fields: --columns {columns_of_table}; fields: {_fields(reader, kinds[0])}"
        )
    rows: dict[str, list[Any]] = {source: [] for source in sorted(mapping.sources)}
    for where, message, stamp in _messages(reader, connections, f"{path}: topic {mapping.topic}"):
        fields = {source: _values(message, source, stamp, where, reader, kinds[0]) for source in rows}
        lengths = {len(values) for values in fields.values() if isinstance(values, list)}
        if len(lengths) > 1:
            raise UnusableInput(f"{where}: lists of lengths {sorted(lengths)} in {listed(rows)}; expected equal ones")
        size = lengths.pop() if lengths else 1
        for source, values in fields.items():
            rows[source] += values if isinstance(values, list) else [values] * size
    frame = pl.DataFrame({source: _series(values, source, path) for source, values in rows.items()})
    if frame.is_empty():
        raise UnusableInput(f"{path}: topic {mapping.topic}: no messages; expected at least one")
    if len(frame) > 1 and "header.stamp" in frame.columns and (frame["header.stamp"] == 0).all():
        raise UnusableInput(f"{path}: topic {mapping.topic}: header.stamp is 0 in every message; give t_s=received")
    return TableFile(Path(f"{path} {mapping.topic}"), frame), mapping


def _standard(kind: str, table: str) -> dict[str, str]:
    """The expressions of a standard message for a table, by target; none for other messages."""
    axes = "xyz"
    if kind == "sensor_msgs/msg/Imu" and table == "imu":
        parts = {f"accel_{a}_mps2": f"linear_acceleration.{a}" for a in axes}
        return {"t_s": "header.stamp"} | parts | {f"gyro_{a}_radps": f"angular_velocity.{a}" for a in axes}
    if kind == "sensor_msgs/msg/Range" and table == "ranges":
        return {"t_s": "header.stamp", "range_m": "range"}
    if kind == "nav_msgs/msg/Odometry" and table == "odometry":
        return {
            "t_s": "header.stamp",
            "speed_mps": "twist.twist.linear.x",
            "yaw_rate_radps": "twist.twist.angular.z",
        }
    if kind in _POSES and table in ("truth", "fixes"):
        position, attitude = _POSES[kind]
        expressions = {"t_s": "header.stamp"} | {f"{a}_m": f"{position}.{a}" for a in axes}
        if table == "truth" and attitude is not None:
            expressions |= {f"q{a}": f"{attitude}.{a}" for a in "wxyz"}
        return expressions
    return {}


def _values(message: Any, source: str, stamp: int, where: str, reader: Any, kind: str) -> Any:
    """The value of a field, or the list of those of all elements."""
    if source == RECEIVED:
        return stamp / 1e9
    values, several = [message], False
    for part in source.split("."):
        match = _PART.fullmatch(part)
        if match is None:
            raise UnusableInput(f"{where}: {source!r} is no field; expected a path such as header.stamp or ranges[].id")
        for name in values:
            if not hasattr(name, match[1]):
                raise UnusableInput(f"{where}: no field {source}; fields: {_fields(reader, kind)}")
        values = [getattr(value, match[1]) for value in values]
        for index in re.findall(r"\[(\d*)\]", match[2]):
            if not index:
                values, several = [item for value in values for item in value], True
                continue
            if any(int(index) >= len(value) for value in values):
                raise UnusableInput(f"{where}: {source}: has fewer than {int(index) + 1} elements")
            values = [value[int(index)] for value in values]
    plain = [_plain(value) for value in values]
    return plain if several else plain[0]


def _plain(value: Any) -> Any:
    """The number or text; times as seconds."""
    if hasattr(value, "nanosec"):
        return value.sec + value.nanosec / 1e9
    return value.item() if hasattr(value, "item") else value


def _series(values: list[Any], source: str, path: Path) -> pl.Series:
    wrong = next((value for value in values if not isinstance(value, (int, float, str))), None)
    if wrong is not None:
        raise UnusableInput(
            f"{path}: field {source} is a {type(wrong).__name__}; expected a number, text or time in it"
        )
    return pl.Series(source, values)


def _fields(reader: Any, kind: str) -> str:
    """The paths of the fields of a message type, for messages; times and the elements of lists are single fields."""
    return listed(_paths(reader.typestore.fielddefs, kind), 24)


def _paths(definitions: Any, kind: str) -> Iterator[str]:
    for name, (node, about) in definitions[kind][1] if kind in definitions else ():
        if node.name in ("ARRAY", "SEQUENCE"):
            name, (node, about) = name + "[]", about[0]
        if node.name == "NAME" and about not in _WHOLE:
            yield from (f"{name}.{path}" for path in _paths(definitions, about))
        else:
            yield name
