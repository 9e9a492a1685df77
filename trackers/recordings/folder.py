"""Recording folders: a `rig.toml` and the tables beside it, read into memory, selected from, and written back.

An unusable file is refused with a message of one line that names it; anomalies in usable data are kept as notices.
"""

from __future__ import annotations

import difflib
import gzip
import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
import polars as pl

from trackwright.trackers.core.data.frames import html_table
from trackwright.trackers.core.errors import UNIX_S, UnusableInput, has_control, listed, seconds
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks.rules import check_rows
from trackwright.trackers.recordings.columns import TagRows, TruePaths
from trackwright.trackers.recordings.files import beside
from trackwright.trackers.recordings.kinds import KINDS, Streams, distinct, std_column, table_kinds
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig, rig_text
from trackwright.trackers.recordings.tables import SUFFIXES, read_table

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration

Kind = Literal["parquet", "csv.gz", "csv"]

FOLDERS = "one or more recording folders, as `read`, `read_all` and `world.folder()` return them"
NO_PATHS = TruePaths(TagRows(pl.DataFrame(schema={"tag": pl.String, "t_s": pl.Float64})))
MANY = 60  # the most recordings that are tracked together: as many as a page shows

_OTHER_DATA = (".txt", ".tsv", ".dat", ".json", ".xlsx", ".zip", ".feather", ".npz", ".mat", ".pq")


class Tables(Mapping[str, pl.DataFrame]):
    """The tables of a recording by name; their rows by tag and the true paths are made once."""

    def __init__(self, frames: Mapping[str, pl.DataFrame]) -> None:
        # A cast of time stamps to numbers would count their unit.
        stamped = {name: of for name, of in frames.items() if of.schema.get("t_s", pl.Float64()).is_temporal()}
        made = {name: of.with_columns(t_s=seconds(of["t_s"].to_numpy())) for name, of in stamped.items()}
        self._frames = {**frames, **made}
        self._rows: dict[tuple[str, float], TagRows] = {}
        self._paths: TruePaths | None = None

    def __getitem__(self, name: str) -> pl.DataFrame:
        return self._frames[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __or__(self, other: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
        return {**self, **other}

    def rows(self, name: str, interval: float = 0.0) -> TagRows:
        """The rows of the table by tag, averaged over intervals of so many seconds where it has readings."""
        key = name, interval if table_kinds()[name].averaged else 0.0
        if key not in self._rows:
            self._rows[key] = TagRows(averaged(self[name], name, interval) if key[1] else self[name])
        return self._rows[key]

    def paths(self, recording: str) -> TruePaths:
        """The true paths of the tags, none without a truth table; `recording`: the name for messages."""
        if self._paths is None:
            self._paths = TruePaths.of_table(self["truth"], recording) if "truth" in self else NO_PATHS
        return self._paths


@dataclass(frozen=True, eq=False, repr=False)
class RecordingFolder:
    """A recording: its geometry, its tables, and notices of anomalies.

    `path`: None for one in memory. `tables`: by name, t_s and values as Float64, ids as String, null where missing.
    `calibration`: what trackers remove from bearings and ranges. `average_s`: interval of its averages, s; None where
    trackers average of themselves; `unaveraged`: what they are of. `origin`: x and y of zero as it was read, m.
    """

    name: str
    path: Path | None
    rig: Rig
    tables: Mapping[str, pl.DataFrame]
    notices: tuple[str, ...] = ()
    calibration: Calibration | None = None
    average_s: float | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    unaveraged: RecordingFolder | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.tables, Tables):
            object.__setattr__(self, "tables", Tables(self.tables))

    def rows(self, table: str, average_s: float = 0.0) -> TagRows:
        """The rows of a table by tag, made once; averages over `average_s` unless the recording has its own."""
        assert isinstance(self.tables, Tables)
        return self.tables.rows(table, average_s if self.average_s is None else 0.0)

    def streams(self, table: str) -> Streams:
        """The readings of a table by stream."""
        rows = self.rows(table)
        return KINDS[table].measured(self.rig, rows).streams(rows.of_each(np.arange(len(rows.tags))))

    @property
    def paths(self) -> TruePaths:
        """The true paths of the tags, none without a truth table; made once."""
        assert isinstance(self.tables, Tables)
        return self.tables.paths(self.name)

    def calibrated(self, calibration: Calibration | None) -> RecordingFolder:
        """This recording with a calibration of what has not moved since, and a notice where nothing is left of it."""
        plain = replace(self, calibration=None)
        if calibration is None:
            return plain
        calibrated = replace(self, calibration=calibration.at_rest(self.rig))
        if len(calibrated.uncalibrated()) < len(plain.uncalibrated()):
            return calibrated
        text = "not calibrated: the calibration has none of its stations and anchors, or they have moved"
        return replace(calibrated, notices=(*calibrated.notices, text))

    def averaged(self, interval: float) -> RecordingFolder:
        """Readings averaged over intervals, s; zero: every one, for trackers that average, too."""
        if not 0 <= interval < math.inf:
            raise UnusableInput(f"interval = {interval:g} s, expected a time above zero, or zero for every reading")
        tables = {name: averaged(table, name, interval) for name, table in self.tables.items()} if interval else {}
        return replace(self, tables=tables or self.tables, average_s=interval, unaveraged=self if interval else None)

    def uncalibrated(self) -> list[str]:
        """Stations with bearings and anchors with ranges that the calibration lacks, in words; all without one."""
        return [
            f"{kind.noun} {name}"
            for table, kind in KINDS.items()
            if kind.calibrated is not None and table in self.tables
            for name in sorted({*chain(*(self.tables[table][of].cast(pl.String).unique() for of in kind.sensors))})
            if self.calibration is None or name not in getattr(self.calibration, kind.calibrated)
        ]

    def __repr__(self) -> str:
        rows = [f"{name} {table.height:,} rows" for name, table in self.tables.items()]
        parts = [*rows, f"{len(self.rig.anchors)} anchors", f"{len(self.rig.stations)} stations"]
        calibrated = ", calibrated but for " + listed(self.uncalibrated()) if self.calibration is not None else ""
        return f"<recording {self.name!r}: {', '.join(parts)}, {len(self.notices)} notices{calibrated}>"

    def _repr_html_(self) -> str:
        rows = [(k, len(t), t["tag"].n_unique(), t["t_s"].min(), t["t_s"].max()) for k, t in self.tables.items()]
        return html_table(repr(self), ("table", "rows", "tags", "from s", "to s"), rows)


def averaged(table: pl.DataFrame, name: str, interval: float) -> pl.DataFrame:
    """A table with a row per tag, sensor and interval, s: means at the mean time, root mean square deviations."""
    kind = table_kinds()[name]
    if not kind.averaged:
        return table
    columns = kind.layout(table.columns)
    means = [_mean(column).alias(column) for column in columns.values]
    means += [pl.col(column).mean() for column in columns.quality]
    stds = (pl.col(std) for std in map(std_column, columns.values) if std in table.columns)
    squares = [std.pow(2).mean().sqrt() for std in stds]
    rows = distinct(table, kind).filter(pl.any_horizontal(pl.col(columns.values).is_not_null()))
    # No column has an empty name.
    groups = rows.group_by((pl.col("t_s") / interval).floor().alias(""), *columns.ids)
    averages = groups.agg(pl.col("t_s").mean(), *means, *squares).sort("t_s", *columns.ids)
    return averages.select(c for c in table.columns if c in ("t_s", *chain(*columns)))


def _mean(column: str) -> pl.Expr:
    """The mean of a column, of an angle the direction of the mean vector."""
    value = pl.col(column)
    if not column.endswith("_rad"):
        return value.mean()
    return pl.when(value.count() > 0).then(pl.arctan2(value.sin().mean(), value.cos().mean()))


@dataclass(frozen=True)
class Selection:
    """Which rows are used: of `tags`, none for all, from `start` to `stop`, s, both included; by default all."""

    tags: tuple[str, ...] = ()
    start: float | None = None
    stop: float | None = None

    def of(self, folder: RecordingFolder) -> RecordingFolder:
        """These rows, and the truth at all times; raises UnusableInput for a tag it lacks, or a table left empty."""
        if self == Selection():
            return folder
        path = folder.path or folder.name
        present = {tag: None for name in folder.tables for tag in folder.tables[name]["tag"].unique().sort()}
        if lacking := [tag for tag in self.tags if tag not in present]:
            raise UnusableInput(f"{path}: no tag {listed(map(repr, lacking))}; its tags: {listed(present, 10)}")
        tables = {name: self._rows(table, name in KINDS, f"{path}: ") for name, table in folder.tables.items()}
        for name, table in tables.items():
            of_tags = self._rows(folder.tables[name], False)
            if of_tags.height and not table.height:
                what = "has no row in the span of time asked for"
                raise UnusableInput(f"{path}: {name} {what}; expected a part of {_span(of_tags)}")
        rig = folder.rig
        if self.tags:
            bodies = {body: tuple(tag for tag in on_it if tag in self.tags) for body, on_it in rig.bodies.items()}
            rig = replace(rig, tags={tag: known for tag, known in rig.tags.items() if tag in self.tags}, bodies=bodies)
        return replace(folder, rig=rig, tables={name: table for name, table in tables.items() if table.height})

    def of_estimates(self, tracks: pl.DataFrame) -> pl.DataFrame:
        """The rows of a table of estimates in these tags and times; raises UnusableInput without any."""
        kept = self._rows(tracks, True)
        if not kept.height:
            tags = listed(tracks["tag"].cast(pl.String).unique().sort())
            expected = f"tags among {tags} and a part of {_span(tracks)}"
            raise UnusableInput(f"no estimate is of these tags and times; expected {expected}")
        return kept

    def _rows(self, table: pl.DataFrame, in_time: bool, where: str = "") -> pl.DataFrame:
        """The rows of the tags, and where asked of the time; raises UnusableInput for times that cannot be meant."""
        if self.tags:
            table = table.filter(pl.col("tag").cast(pl.String).is_in(list(self.tags)))
        low, high = (-math.inf if self.start is None else self.start, math.inf if self.stop is None else self.stop)
        if not in_time or not table.height or (low, high) == (-math.inf, math.inf):
            return table
        first = float(table["t_s"].to_numpy().min())
        for time in (low, high):
            if 0.0 < time < UNIX_S <= first:
                fix = f"{time:.12g} s after the start is {first + time:.12g}"
                raise UnusableInput(f"{where}the times count from 1970, and {time:.12g} s is long before them; {fix}")
        return table.filter(pl.col("t_s").is_between(low, high))


def _span(table: pl.DataFrame) -> str:
    times = table["t_s"].to_numpy()
    return f"{times.min():.12g} to {times.max():.12g} s"


def read_recordings(paths: Sequence[str | Path], refused: list[str] | None = None) -> list[RecordingFolder]:
    """Several recordings; raises UnusableInput, unless `refused` gets what is said of those left out."""
    refuse_repeated(paths)
    recordings = []
    for path in paths:
        try:
            recordings.append(read_recording(path))
        except UnusableInput as problem:
            if refused is None:
                raise
            refused.append(str(problem))
    refuse_same_names([recording.name for recording in recordings])
    return recordings


def refuse_same_names(names: Sequence[str]) -> None:
    """Raises UnusableInput for two recordings of one name."""
    for same in (name for k, name in enumerate(names) if name in names[:k]):
        raise UnusableInput(f"two recordings are both named '{same}'; expected different names in rig.toml; rename one")


def refuse_repeated(paths: Sequence[str | Path]) -> None:
    """Raises UnusableInput for an empty list of recordings, and for a folder given twice."""
    if not paths:
        raise UnusableInput("no recording given; expected one or more recording folders")
    places = [Path(path).resolve() for path in paths]
    for same in (path for path, place in zip(paths, places, strict=True) if places.count(place) > 1):
        raise UnusableInput(f"{same}: is given more than once; expected each recording once; remove one")


def read_recording(path: str | Path, placed: bool = True) -> RecordingFolder:
    """The recording in a folder; raises UnusableInput. `placed`: whether its anchors must be in rig.toml."""
    path = Path(path)
    rig, files, notices, others = _contents(path)
    tables, ignored = {}, []
    if others:
        own = "check and track read your own kinds by --tracker FILE.py:NAME"
        ignored.append(f"{listed(others)} (not one of the tables {', '.join(table_kinds())}; {own})")
    for name, file in files.items():
        tables[name], table_notices, columns = read_table(file, name, rig, placed or name != "ranges")
        notices += table_notices
        if columns:
            which = f"column{'s' if len(columns) > 1 else ''} {listed(map(repr, columns))}"
            ignored.append(f"{which} of {file.name} (not part of the format, or not numbers)")
    if ignored:
        notices.append(f"ignored: {'; '.join(ignored)}")
    measured = {tag for name in KINDS if name in tables for tag in tables[name]["tag"].unique()}
    true = {*tables["truth"]["tag"].unique()} if "truth" in tables else measured
    if measured and not measured & true:
        found = f"truth has {listed(map(repr, sorted(true)))}, measurements have {listed(map(repr, sorted(measured)))}"
        raise UnusableInput(f"{path}: no common tag: {found}; expected the same ids in both; correct their spelling")
    notices += (f"{one.where}: {one.message}" for one in check_rows(rig, tables))
    return RecordingFolder(rig.name, path, rig, tables, tuple(notices))


def write_recording(folder: RecordingFolder, path: str | Path, kind: Kind = "parquet") -> None:
    """Writes the recording to a new or empty folder, whole or not at all; raises UnusableInput where it cannot."""
    if kind not in get_args(Kind):
        raise UnusableInput(f"kind = {kind!r}, expected one of {', '.join(get_args(Kind))}")
    path = Path(path)
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            what = "folder is not empty" if path.is_dir() else "is a file"
            raise UnusableInput(f"{path}: {what}, expected a new or empty folder to write to; choose another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside(path, Path.mkdir) as partial:
            (partial / RIG_FILE).write_text(rig_text(folder.rig), encoding="utf-8")
            for name, table in folder.tables.items():
                file = partial / f"{name}.{kind}"
                if kind == "parquet":
                    table.write_parquet(file)
                else:
                    # Without name and time in the gzip header, equal tables give equal bytes.
                    text = table.write_csv().encode()
                    file.write_bytes(text if kind == "csv" else gzip.compress(text, 6, mtime=0))
            if path.exists():
                path.rmdir()  # some systems do not rename onto an empty folder
            partial.rename(path)
    except (OSError, pl.exceptions.PolarsError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise UnusableInput(f"{path}: cannot be written ({reason}); check free space and permissions") from error


def _contents(path: Path) -> tuple[Rig, dict[str, Path], list[str], list[str]]:
    """The rig, the file of each table, notices, and the names of other tables; raises UnusableInput."""
    if has_control(str(path)):
        raise UnusableInput(f"{path}: has a control character or bytes that are no UTF-8 in its name; rename it")
    try:
        entries = sorted(entry.name for entry in path.iterdir())
    except OSError as error:
        fix = "expected a recording folder; check the path"
        raise UnusableInput(f"{path}: cannot be read ({error.strerror}), {fix}") from error
    rig, notices = read_rig(path / RIG_FILE)
    kinds, files, others = table_kinds(), dict[str, Path](), list[str]()
    for entry in entries:
        stem = entry.partition(".")[0]
        if entry != RIG_FILE and is_part(entry):
            if stem in files:
                raise UnusableInput(f"{path}: both {files[stem].name} and {entry}, expected one; remove the other")
            files[stem] = path / entry
        elif entry.lower().endswith((*SUFFIXES, *_OTHER_DATA)):
            others.append(entry)
    for entry in others:
        absent = [name for name in kinds if name not in files]
        if near := difflib.get_close_matches(entry.partition(".")[0].lower(), absent, 1, 0.75):
            names = " or ".join(near[0] + suffix for suffix in SUFFIXES)
            raise UnusableInput(f"{path / entry}: looks like table {near[0]}, expected {names}; rename or convert it")
    others = [entry for entry in others if entry.lower().endswith(SUFFIXES)]
    if not files:
        another = f"found {listed(others)}; another kind needs --tracker FILE.py:NAME with it (docs/extending.md)"
        expected = f"at least one of {', '.join(kinds)} as {', '.join(SUFFIXES)}"
        raise UnusableInput(f"{path}: no tables, expected {expected}; {another if others else 'export one'}")
    return rig, files, [*notices], others


def is_part(name: str) -> bool:
    """Whether a file of this name is a rig.toml or a table of a recording."""
    stem, _, suffix = name.partition(".")
    return name == RIG_FILE or (stem in table_kinds() and f".{suffix}" in SUFFIXES)


def recordings_under(path: Path) -> list[Path]:
    """The recordings at or below a folder, sorted, also those that cannot be read; itself where there is none."""
    recordings, seen = list[Path](), set[str]()
    for root, folders, files in os.walk(path, onerror=lambda e: recordings.append(Path(e.filename)), followlinks=True):
        real = os.path.realpath(root)
        if real in seen or any(map(is_part, files)):
            folders.clear()
            if real not in seen:
                recordings.append(Path(root))
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
    return sorted(recordings) or [path]


def archive_of(paths: Sequence[Path], keep_going: bool) -> list[Path] | None:
    """The recordings in these folders, None where they are few and none is a folder of folders, unless `keep_going`."""
    groups = [recordings_under(path) for path in paths]
    recordings = [path for group in groups for path in group]
    if not keep_going and len(recordings) <= MANY and groups == [[path] for path in paths]:
        return None
    refuse_repeated(recordings)
    return recordings


def content_of(path: Path) -> str:
    """A digest of the rig.toml and the tables of a recording, and of the names beside them; raises OSError."""
    digest = hashlib.sha256()
    for entry in sorted(path.iterdir()):
        digest.update(os.fsencode(entry.name) + b"\0")
        if entry.is_file() and is_part(entry.name):
            digest.update(hashlib.sha256(entry.read_bytes()).digest())
    return digest.hexdigest()
