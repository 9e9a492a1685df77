"""Files and frames of other programs made recordings: brought into one frame, checked as any, and written at once.

Bags of ROS 1 and ROS 2, and MCAP files, become columns of numbers and texts by the package rosbags.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, listed, near, require
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.on_demand import fault_of, from_file, split_name
from trackwright.trackers.exchange.mapping import ORIGIN, Source, TableMapping, read_mapping
from trackwright.trackers.exchange.text_tables import Reading, columns_of, parsed, read_rows, sensor_of, texts_of
from trackwright.trackers.exchange.trajectories import Similarity, read_tum
from trackwright.trackers.recordings.checks.readings import Compared, about_vertical, compared, known_median, robust_fit
from trackwright.trackers.recordings.files import beside, file_bytes
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.kinds import KINDS, table_kinds
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig, rig_text
from trackwright.trackers.recordings.tables import SUFFIXES, TableFile, first_row, unwrapped

LONGEST_S, STEP_S = 10.0, 0.5  # differences of the clocks that are searched: some decimetres of motion between two
FEW, NEAR = 240, 3  # readings of the search, and how many of its 24 turns are refined at each difference
CLEARLY = 1.5  # factor of errors without a shift in z to those with it


def placed(truth: pl.DataFrame, numbers: Sequence[float]) -> pl.DataFrame:
    """A truth turned about z by `numbers[3]`, °, then shifted by the first three, m, and by the last, s, in time."""
    x, y, z, yaw, later = map(float, numbers)
    moved = Similarity(about_vertical(math.radians(yaw)), np.array([x, y, z])).table(truth)
    return moved.with_columns(pl.col("t_s") + later)


def moved_truth(truth: pl.DataFrame, recording: RecordingFolder, transform: str | None) -> tuple[pl.DataFrame, str]:
    """A truth moved by X,Y,Z,YAW,S, or as the readings of a recording fit it, and how; raises UnusableInput."""
    if transform is None:
        tables = dict(recording.tables) | {"truth": truth.sort("t_s", maintain_order=True)}
        numbers, words = found_placement(replace(recording, tables=tables))
        text = ",".join(f"{round(x, 3) + 0.0:.3f}" for x in numbers)
        return placed(truth, numbers), f"truth moved by --transform {text}: {words}"
    numbers = pl.Series(transform.split(",")).cast(pl.Float64, strict=False).fill_null(math.nan).to_list()
    if len(numbers) not in (4, 5) or not np.isfinite(numbers).all():
        expected = "X,Y,Z,YAW or X,Y,Z,YAW,S: a shift in m after a turn about z in degrees, and s added to the times"
        raise UnusableInput(f"--transform {transform}: expected {expected}")
    return placed(truth, [*numbers, 0.0][:5]), f"truth moved by --transform {transform}"


def found_placement(recording: RecordingFolder) -> tuple[list[float], str]:
    """The numbers of `placed` that the readings fit best, and how well, in words; or UnusableInput.

    Without a shift in z unless errors are larger by `CLEARLY` without it: biases of ranges go into z above all.
    """
    view = next((view for table in KINDS if (view := compared(recording, table)) is not None), None)
    if view is None:
        fix = "import some of the same tag on about its clock first (a truth without z needs height_m), or --transform"
        raise UnusableInput(f"--align-truth: {recording.name}: no measurement at the times of the truth; {fix}")
    centre, kept = view.positions.mean(axis=0), ""

    def errors(x: np.ndarray) -> np.ndarray:
        return _errors(view.later(float(x[4])), centre, x)

    def sizes(x: np.ndarray, bias: bool = True) -> np.ndarray:
        return np.asarray(known_median(view.sizes(errors(x), bias)))

    x, _ = robust_fit(errors, _searched(view.thinned(FEW), centre))
    level = np.insert(robust_fit(lambda y: errors(np.insert(y, 3, centre[2])), np.delete(x, 3))[0], 3, centre[2])
    if not (sizes(level, False) > CLEARLY * sizes(x, False)).any():
        kept = f"z as it was, since errors are about as small without its shift of {x[3] - centre[2]:.2f} m; "
        x = level
    known = np.isfinite(sizes(x))
    typical = ", ".join(f"{size:.2g} {view.kind.unit}" for size in sizes(x)[known])
    if not (sizes(x) <= view.kind.sizes("large", len(known)))[known].all():
        found = f"no turn about z, shift and difference of clocks up to {LONGEST_S:g} s explains the {view.kind.name}"
        raise UnusableInput(f"--align-truth: {found}: errors of {typical} are left; check the rig and the tag")
    shift, yaw = x[1:4] - about_vertical(x[0]) @ centre, math.degrees(math.remainder(x[0], 2 * math.pi))
    return [*shift.tolist(), yaw, float(x[4])], f"{kept}{view.kind.name} then differ by {typical} typically"


def _errors(view: Compared, centre: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The errors of the readings with the truth turned by x[0], rad, about `centre`, which goes to x[1:4]."""
    return view.turned(float(x[0]), centre, x[1:4]).errors()


def _searched(view: Compared, centre: np.ndarray) -> np.ndarray:
    """The best of some turns at each difference of the clocks, each with the shift that fits it."""
    middle = np.nanmean((view.values if view.kind.position else view.sensors.places)[:, :2], axis=0)
    fits = []
    for later in np.arange(-LONGEST_S, LONGEST_S + STEP_S, STEP_S):
        known = np.isfinite((shifted := view.later(float(later))).positions).all(axis=1)
        if 2 * known.sum() >= len(known):
            errors = partial(_errors, shifted.of_rows(known), centre)
            starts = [np.append(yaw, [*middle, centre[2]]) for yaw in np.arange(24) * np.pi / 12]
            starts.sort(key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x))))))
            x, size = min((robust_fit(errors, start, 8) for start in starts[:NEAR]), key=lambda fit: fit[1])
            fits.append((size, np.append(x, later)))
    return min(fits, key=lambda fit: fit[0])[1]


FORMATS = {"csv": (*SUFFIXES, ".tsv"), "json": (".jsonl", ".ndjson", ".json"), "tum": (".tum",),
           "ros": (".bag", ".mcap", ".db3")}  # fmt: skip
"""Endings of files by the name of their format."""


def format_of(path: Path) -> str:
    """The name of a file's format, by its ending; of others a table in text."""
    named = (name for name, endings in FORMATS.items() if path.name.lower().removesuffix(".gz").endswith(endings))
    return "ros" if path.is_dir() else next(named, "csv")


def read_source(path: Path, name: str, mappings: Sequence[TableMapping], tag: str | None = None) -> Source:
    """The tables of a source in the format of this name, or a user's own; raises UnusableInput with file and line."""
    if name not in FORMATS:
        return _of_frames(_own_frames(path, name), {}, tag, f"{name}: ")
    if name == "ros":
        return read_bag(path, mappings)
    source = Source()
    for mapping in mappings:
        file, notices = (read_tum(path), []) if name == "tum" else read_rows(path, mapping, name == "json")
        source.notices += [line for line in notices if line not in source.notices]
        if len(file.frame):  # a log may have lines of some of the tables alone
            source.read(file, mapping)
    if not source.tables:
        raise UnusableInput(f"{path}: no line has values; expected a JSON object in each, or what fits the mapping")
    return source


def _own_frames(path: Path, name: str) -> Mapping[str, Any]:
    """The frames by table that a function of the user, FILE.py:NAME, makes of a source; raises UnusableInput."""
    if not split_name(name)[0]:
        raise UnusableInput(f"--format {name}: expected {', '.join(FORMATS)} or FILE.py:NAME{near(name, FORMATS)}")
    function: Callable[[Path], Any] = from_file(name, "format", "function", lambda x: isinstance(x, FunctionType))
    try:
        frames = function(path)
    except UnusableInput:
        raise
    except Exception as error:
        fault = fault_of(error, Path(split_name(name)[0]))
        raise UnusableInput(f"{path}: {name} fails ({fault}); correct either") from error
    if not isinstance(frames, Mapping) or not frames:
        raise UnusableInput(f"{name}: gave {type(frames).__name__} of {path}; expected tables by name, one at least")
    return frames


def _of_frames(
    frames: Mapping[str, Any], columns: Mapping[str, Mapping[str, str]], tag: str | None, where: str
) -> Source:
    """The tables of pandas or polars frames by expressions of each table."""
    source = Source()
    if unknown := {*frames} - {*table_kinds()}:
        raise UnusableInput(f"{where}table {min(unknown)!r}; expected one of {', '.join(table_kinds())}")
    for table, frame in frames.items():
        file = TableFile(Path(f"{where}{table}"), _polars(frame, f"{where}{table}"))
        source.read(file, TableMapping(table=table, columns=columns.get(table, {}), tag=tag))
    return source


def _polars(frame: Any, table: str) -> pl.DataFrame:
    if isinstance(frame, pl.LazyFrame | pl.DataFrame):
        return frame.lazy().collect()
    if type(frame).__module__.partition(".")[0] != "pandas":
        raise UnusableInput(f"{table}: found {type(frame).__name__}; expected a pandas or polars frame")
    # An index that is not the row number holds values, often the times.
    frame = frame if type(frame.index).__name__ == "RangeIndex" else frame.reset_index()
    require(frame.columns.is_unique, table, listed(frame.columns, 12), "a name for each column, once")
    plain = {str(name): column.astype(object).where(column.notna(), None).tolist() for name, column in frame.items()}
    return pl.DataFrame(plain, strict=False)


def import_frames(
    frames: Mapping[str, Any], rig: Rig | Path | str | None = None,
    columns: Mapping[str, Sequence[str]] | None = None, tag: str | None = None, name: str | None = None,
) -> RecordingFolder:  # fmt: skip
    """A recording from pandas or polars frames by table, checked as if it were read from a folder.

    `rig`: the geometry, or the path of a rig.toml. `columns`: by table, expressions such as `t_s=stamp in ms`
    (docs/import.md). `tag`: the id of all rows, where no column has it. Raises UnusableInput.
    """
    require(isinstance(frames, Mapping), "import_frames", frames, "frames by table, as {'ranges': frame}")
    source = _of_frames(frames, {table: columns_of(e) for table, e in (columns or {}).items()}, tag, "frame ")
    rig = read_rig(Path(rig))[0] if isinstance(rig, (str, Path)) else rig
    with tempfile.TemporaryDirectory() as scratch:
        read = _written(_assembled(name, rig, source), Path(scratch) / "recording", source)
    return replace(read, path=None, notices=(*source.notices, *read.notices))


def _assembled(name: str | None, rig: Rig | None, source: Source) -> RecordingFolder:
    """The recording of the tables of a source, with a rig; raises UnusableInput."""
    if rig is None and "ranges" in source.tables:
        fix = "give a rig.toml or a table of them by --rig (in Python: rig=), a rig.toml without anchors for a survey"
        raise UnusableInput(f"ranges: no positions of anchors; {fix}")
    rig = rig or Rig("imported")
    return RecordingFolder(name or rig.name, None, replace(rig, name=name or rig.name), source.tables)


def _saved(folder: RecordingFolder, out: Path, source: Source, replaced: bool) -> RecordingFolder:
    """Writes the recording, or adds its tables to that in `out`; returns it as read back, with new notices.

    Rows are checked in the order of the source and written by time; nothing is written of what is refused.
    """
    there = _read(out) if (out / RIG_FILE).is_file() else None
    if there is None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UnusableInput(f"--out {out}: exists; expected a new folder, or a recording to add tables to")
    known = {} if there is None else dict(there.tables)
    if not replaced and (twice := [name for name in folder.tables if name in known]):
        raise UnusableInput(f"--out {out}: has the table {twice[0]} already; expected another; --replace replaces it")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside(out, Path.mkdir) as scratch:
            read = _written(replace(folder, tables=known | dict(folder.tables)), scratch / "recording", source)
            out.mkdir(exist_ok=True)
            for path in (out / f"{name}{suffix}" for name in folder.tables for suffix in SUFFIXES):
                path.unlink(missing_ok=True)
            same = there is not None and rig_text(folder.rig) == rig_text(there.rig)
            for file in (*(f"{name}.parquet" for name in folder.tables), *([] if same else [RIG_FILE])):
                (scratch / "recording" / file).replace(out / file)
    except OSError as error:
        raise UnusableInput(f"--out {out}: cannot be written ({error.strerror}); check its permissions") from error
    before = () if there is None else there.notices
    return replace(read, path=out, notices=tuple(line for line in read.notices if line not in before))


def _written(folder: RecordingFolder, path: Path, source: Source) -> RecordingFolder:
    """The recording, written to `path` and read back; a refusal names the place in the source."""
    tables = {name: table.drop(ORIGIN, strict=False) for name, table in folder.tables.items()}
    write_recording(replace(folder, tables=tables), path)

    def original(match: re.Match[str]) -> str:
        return source.location(match[1], int(match[2]) - 1, match[3]) if match[1] in source.tables else match[0]

    try:
        read = _read(path)
    except UnusableInput as problem:
        cell = rf"{re.escape(str(path))}/(\w+)\.parquet: row (\d+), column (\w+)"
        raise UnusableInput(re.sub(cell, original, str(problem)).replace(str(path), "imported")) from problem
    for name, table in tables.items():
        if not table["t_s"].is_sorted():
            straight, _ = unwrapped(table, table_kinds()[name].layout(table.columns).ids)
            straight.sort("t_s", maintain_order=True).write_parquet(path / f"{name}.parquet")
    return read


def _read(path: Path) -> RecordingFolder:
    """The recording; its ranges may be to anchors that are to be surveyed where its rig has none."""
    return read_recording(path, placed=bool(read_rig(path / RIG_FILE)[0].anchors))


def _geometry(path: Path | None, out: Path, reading: Reading) -> tuple[Rig | None, list[str]]:
    """The rig in `out`, or where that is empty, one with the rig or the anchors in the file `path`; and notices."""
    there = read_rig(out / RIG_FILE)[0] if (out / RIG_FILE).is_file() else None
    if path is None:
        return there, []
    if there is not None and (there.anchors or there.stations):
        raise UnusableInput(f"--rig {path}: {out} has a rig.toml already; expected one; leave --rig out")
    rig, notices = (read_rig(path)[0], []) if path.suffix == ".toml" else _read_anchors(path, reading)
    return rig if there is None else replace(rig, name=there.name, tags=dict(there.tags) | dict(rig.tags)), notices


def _read_anchors(path: Path, reading: Reading) -> tuple[Rig, list[str]]:
    """The anchors in a table with ids and columns as `X`, `x_mm`, `x [mm]`, `X (m)`; and notices."""
    # The separator and the header of the readings are not theirs.
    file, notices = read_rows(path, replace(reading, separator=None, header="", skip=0, missing=(), lines=None))
    if units := [line for line in notices if "has units" in line]:
        raise UnusableInput(f"--rig {path}: {units[0].partition(';')[0]}; expected them in the header, as x_mm")
    matches = {n: re.fullmatch(r"([xyz])(?:[\W_]+(\w+)\W*)?", n.strip().lower()) for n in file.frame.columns}
    axes = {m[1]: f"`{name}` in {m[2] or 'm'}" for name, m in matches.items() if m}
    others = [name for name, match in matches.items() if not match]
    ids = [name for name in others if name.lower() in ("anchor", "anchor_id", "id", "name")] or others
    if sorted(m[1] for m in matches.values() if m) != [*"xyz"] or len(ids) != 1:
        expected = "anchor, x, y, z (m; x_mm or x [mm]: mm), or a rig.toml"
        raise UnusableInput(f"--rig {path}: columns {listed(map(repr, matches), 12)}; expected {expected}")
    places = [parsed("x_m", axes[axis], file).numbers(file).alias(axis) for axis in "xyz"]
    rows = pl.DataFrame([texts_of(file.frame[ids[0]]).replace("", None).alias("id"), *places])
    lacking = rows.select(pl.any_horizontal(pl.all().is_null()) | ~pl.col("id").is_first_distinct()).to_series()
    if lacking.any():
        where = file.location(first_row(lacking), ids[0])
        raise UnusableInput(f"--rig {where}: expected each id once, with x, y, z")
    notices.append(f"ids are in column {ids[0]}, positions in {', '.join(axes[axis] for axis in 'xyz')}")
    anchors = {key: np.array(place) for key, *place in rows.rows()}
    return Rig(path.stem, anchors), [f"{path}: {line}" for line in notices]


def import_file(
    source: Path, out: Path, mappings: Sequence[TableMapping], tag: str | None = None, format: str | None = None,
    rig: Path | None = None, transform: str | None = None, align_truth: bool = False, replaced: bool = False,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[Mapping[str, pl.DataFrame], RecordingFolder]:  # fmt: skip
    """The tables imported from a source into the folder `out` as by `trackwright import`, and the recording there.

    `tag`: of a user's own `format`, which has no `mappings`. `say` gets notices. Raises UnusableInput.
    """
    name = format or format_of(source)
    say(f"{source}: read as {name}" + ("" if format else "; another format: --format"))
    if bool(mappings) != (name in FORMATS):
        raise UnusableInput(f"{source}: expected --table or --mapping, and none with --format FILE.py:NAME")
    known, lines = _geometry(rig, out, mappings[0] if len(mappings) == 1 else Reading())
    imported = read_source(source, name, mappings, tag)
    # Recordings of one installation share its rig, but not their name.
    there = (out / RIG_FILE).is_file()
    folder, lines = _assembled(None if there else out.resolve().name, known, imported), [*imported.notices, *lines]
    if transform is not None or align_truth:
        if "truth" not in folder.tables:
            raise UnusableInput("--transform and --align-truth move a truth; expected --table truth")
        truth, said = moved_truth(folder.tables["truth"], read_recording(out) if there else folder, transform)
        folder, lines = replace(folder, tables=dict(folder.tables) | {"truth": truth}), [*lines, said]
    written = _saved(folder, out, imported, replaced)
    for line in (*lines, *(f"{out}: {line}" for line in written.notices)):
        say(f"notice: {line}")
    return imported.tables, written


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
        values = {n: _values(message, n, stamp, f"{where}: no field {n}; fields: {fields}") for n in rows}
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
