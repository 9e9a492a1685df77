"""A catalogue entry of a tracker, and the tracker by name that it makes, with noise levels, for recording folders.

Recordings in map coordinates are tracked about an origin nearby: single precision resolves 5e6 m to half a metre.
Readings that a source repeats until it has a new one are used once; the rounding of readings is part of their variance.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, one_or_more
from trackwright.trackers.core.model.rig import ELSEWHERE_M, Rig
from trackwright.trackers.core.model.tunable import AbstractTunable, tunables, with_values
from trackwright.trackers.core.on_demand import fault_of
from trackwright.trackers.core.run.requirements import check_input
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.kinds import KINDS, MANY_REPEATS, Streams, distinct, std_column, table_kinds
from trackwright.trackers.recordings.tracks import TrackerBatch, Tracks, Trajectories, Trajectory, known_height, track

Recordings = RecordingFolder | Sequence[RecordingFolder]
Key = tuple[bool, Hashable]  # whether a batch is planar, and the installation built into its tracker

FAR_M = 1000.0  # x or y, m, from which on coordinates are a map's, if beyond the site
# Least pairs that tell of repeats, least share of repeats that chance does not explain where a source repeats its
# readings, and least size of a clear change, in steps.
LEAST_PAIRS, HELD, CLEAR = 50, 0.5, 1.5
# Most differences of a column, least that tell a quantisation step, share of these that are multiples, and distance
# from one in steps: one in 25 continuous values is as near.
MOST_DIFFERENCES, LEAST_VALUES, MULTIPLES, NEAR = 20_000, 20, 0.95, 0.02
QUANTILES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)


@contextmanager
def faults_named(tracker: str, name: str, function: Callable[..., Any]) -> Iterator[None]:
    """Raises UnusableInput, with the line, where a function of a user's tracker fails; else the fault as it is."""
    try:
        yield
    except (UnusableInput, MemoryError):
        raise
    except Exception as error:
        code = getattr(function, "__code__", None)
        if code is None or function.__module__.startswith("trackwright."):
            raise
        file = Path(code.co_filename)
        raise UnusableInput(f"{tracker}: {name} failed ({fault_of(error, file)}); correct {file.name}") from error


@dataclass(frozen=True)
class TrackerSpec:
    """A tracker of the catalogue, or a user's own.

    `about`: one line for lists and help. `table`: the table it reads. `trajectories(folder, free_height)`: the rows of
    every tag (or of every tag and station) of a recording folder. `build(trajectory, planar)`: the tracker for a
    trajectory. `lacks(folder)`: what a folder lacks for it, in words, or None where it fits; by default the table.
    `geometry(trajectory)`: the part of the installation that is built into the tracker; trajectories that agree in
    it and in `planar` run as one batch. `planar(trajectory, free_height)`: whether the state lies in a plane. Both are
    asked once for all tags of a folder that share station and known height, where the rows are `Trajectories`.
    `notices(folder, free_height)`: a line for each tag of which the tracker assumes what the folder contradicts.
    `automatic(folder)`: whether the tracker may be chosen for a folder that it fits when none is named.
    `bearing_only`: it estimates directions, not positions. `every_row`: the tables of which it reads rows that repeat a
    value, too, since it averages them, counts rows, or estimates each time by itself. `places(trajectories, planar)`: a
    function that computes the input `nearby` from readings, as of `AbstractPlaces`, of the rows of one tag.
    """

    about: str
    table: str
    trajectories: Callable[[RecordingFolder, bool], Iterable[Trajectory]]
    build: Callable[[Trajectory, bool], AbstractTracker]
    lacks: Callable[[RecordingFolder], str | None] | None = None
    geometry: Callable[[Trajectory], Hashable] = lambda trajectory: ()
    planar: Callable[[Trajectory, bool], bool] = lambda x, free: not free and known_height(x.folder, x.tag) is not None
    notices: Callable[[RecordingFolder, bool], Iterable[str]] = lambda folder, free_height: ()
    automatic: Callable[[RecordingFolder], bool] = lambda folder: True
    bearing_only: bool = False
    every_row: Collection[str] = ()
    places: Callable[[Trajectories, bool], Any] | None = None

    @property
    def reads(self) -> frozenset[str]:
        """The words of `table`, among them the tables that it reads."""
        return frozenset(re.findall(r"\w+", self.table))

    def missing(self, folder: RecordingFolder) -> str | None:
        """What the folder lacks for this tracker, in words, or None where it fits."""
        if self.lacks is not None:
            return self.lacks(folder)
        return None if self.table in folder.tables else f"a {self.table} table, found no such table"

    def refusal(self, folder: RecordingFolder, name: str) -> str | None:
        """Why the tracker, of this name, does not run on the folder, in one line; None where it fits."""
        if (missing := self.missing(folder)) is None:
            return None
        return f"{folder.path or folder.name}: tracker '{name}' needs {missing}; its tables: {', '.join(folder.tables)}"

    def batches(self, folders: Sequence[RecordingFolder], name: str, free_height: bool = False) -> list[TrackerBatch]:
        """The trajectories of all folders, batched by tracker; raises UnusableInput for one that lacks something."""
        grouped: dict[Key, list[Trajectories]] = defaultdict(list)
        for folder in folders:
            if refused := self.refusal(folder, name):
                raise UnusableInput(refused)
            with faults_named(name, "trajectories", self.trajectories):
                rows = self.trajectories(folder, free_height)
                groups = [rows] if isinstance(rows, Trajectories) else [Trajectories.of([one]) for one in rows]
            with faults_named(name, "planar", self.planar):
                for group in groups:
                    for key, part in self._parts(group, free_height).items():
                        grouped[key].append(part)
        joined = {key: Trajectories.joined(parts) for key, parts in grouped.items()}
        with faults_named(name, "build", self.build):
            built = [
                TrackerBatch(self.build(mine[0], planar), mine, planar, places=self.places)
                for (planar, _), mine in joined.items()
            ]
        for batch in built if ":" in name else ():  # a user's own, FILE.py:NAME
            with faults_named(name, "run", self.build):
                check_input(batch.tracker, batch.trajectories[0].recording, name)
        return built

    def _parts(self, trajectories: Trajectories, free_height: bool) -> dict[Key, Trajectories]:
        """The trajectories by `planar` and `geometry`, which are the first one's of each station and height."""
        kinds: dict[tuple[str, float], Key] = {}
        parts: dict[Key, list[int]] = defaultdict(list)
        heights = np.nan_to_num(trajectories.heights, nan=np.inf).tolist()
        for number, kind in enumerate(zip(trajectories.stations, heights, strict=True)):
            if kind not in kinds:
                first = trajectories[number]
                kinds[kind] = self.planar(first, free_height), self.geometry(first)
            parts[kinds[kind]].append(number)
        return {key: trajectories.chosen(np.array(numbers)) for key, numbers in parts.items()}


@dataclass(frozen=True, repr=False)
class NamedTracker:
    """A tracker of the catalogue, or a user's own, for recording folders.

    `tracker`: of the first trajectory it was made for. `side`: of tags, above or below anchors in one plane. `values`:
    numbers by tunable name or pattern, from `source`, in every recording. `smoothed`: with `lag` seconds of later rows,
    or all. Other geometry gets a tracker of its own. `made_for`: recordings and their rows, made only once.
    """

    name: str
    spec: TrackerSpec
    tracker: AbstractTracker
    free_height: bool = False
    side: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    source: str = "values"
    smoothed: bool = False
    lag: float | None = None
    made_for: tuple[list[RecordingFolder], list[TrackerBatch]] = field(default_factory=lambda: ([], []))

    @classmethod
    def of(
        cls, name: str, spec: TrackerSpec, recordings: Recordings, free_height: bool = False, side: str | None = None
    ) -> NamedTracker:
        """The tracker of an entry for recordings; raises UnusableInput for a recording that lacks what it reads."""
        folders = folder_list(recordings)
        groups = _batches(spec, folders, name, free_height, side)
        if not groups:
            raise UnusableInput(f"tracker '{name}': no trajectory in the recordings; expected one tag at least")
        return cls(name, spec, groups[0].tracker, free_height, side, made_for=(folders, groups))

    def run(
        self, recordings: Recordings, advance: Callable[[int], None] = lambda done: None, *, seed: int = 0
    ) -> Tracks:
        """The estimates of every tag; `advance` gets the number done, `seed` is of filters that draw."""
        return self.track(self.batches(recordings), advance, seed=seed)

    def track(
        self, batches: Sequence[TrackerBatch], advance: Callable[[int], None] = lambda done: None, *, seed: int = 0
    ) -> Tracks:
        """The estimates of `batches`, as `run`."""
        with faults_named(self.name, "run", self.spec.build):
            return track(batches, advance, seed)

    def batches(self, recordings: Recordings) -> list[TrackerBatch]:
        """The trajectories, about an origin nearby, each reading once, and their trackers with these numbers."""
        folders = folder_list(recordings)
        made_for, groups = self.made_for
        # Rows of long recordings take longer to make than to filter.
        if len(folders) != len(made_for) or any(a is not b for a, b in zip(folders, made_for, strict=True)):
            groups = _batches(self.spec, folders, self.name, self.free_height, self.side)
        return [replace(g, tracker=self._finished(with_values(g.tracker, self.values, self.source))) for g in groups]

    def only_batch(self, recordings: Recordings) -> TrackerBatch:
        """All trajectories for one tracker, as a fit needs them; raises UnusableInput where they need several."""
        groups = self.batches(recordings)
        if len(groups) != 1:
            raise UnusableInput(
                f"the recordings need {len(groups)} different '{self.name}' trackers (other geometry, or heights known "
                "for some tags only); expected one; take them apart, or estimate all heights (free_height)"
            )
        return groups[0]

    @property
    def tunables(self) -> dict[str, AbstractTunable]:
        """The numbers that can be tuned, by name."""
        return tunables(self.tracker)

    def with_values(self, values: Mapping[str, Any], source: object = "values") -> NamedTracker:
        """This tracker with other values by tunable name or pattern; raises UnusableInput where they do not fit."""
        tracker = with_values(self.tracker, values, source)
        return replace(self, tracker=tracker, values={**self.values, **values}, source=str(source))

    def smoothing(self, lag: float | None = None) -> NamedTracker:
        """This tracker, smoothed by all later rows or `lag` seconds of them; raises UnusableInput where it cannot."""
        smoother = replace(self, smoothed=True, lag=lag)
        smoother._finished(self.tracker)
        return smoother

    def _finished(self, tracker: Any) -> AbstractTracker:
        """A tracker of the catalogue, smoothed where this one is."""
        if self.smoothed:
            from trackwright.trackers.core.run.smoother import Smoothed

            try:
                tracker = Smoothed(tracker, self.lag)
            except TypeError as error:
                fix = "run it without smoothing"
                raise UnusableInput(f"tracker '{self.name}' cannot be smoothed: {error}; {fix}") from error
        return tracker  # type: ignore[no-any-return]

    def __repr__(self) -> str:
        return f"<tracker {self.name}: {self.spec.about}; tunables {', '.join(self.tunables)}>"


def _batches(
    spec: TrackerSpec, folders: Sequence[RecordingFolder], name: str, free_height: bool, side: str | None
) -> list[TrackerBatch]:
    """The batches of recordings as trackers read them: about an origin nearby, each reading once."""
    names = spec.reads.difference(spec.every_row)
    if side is not None:
        folders = [replace(folder, rig=replace(folder.rig, side=side)) for folder in folders]
    prepared = [counted_once(near_origin(folder), names) for folder in folders]
    groups = spec.batches([with_rounding(folder, spec.reads) for folder, _ in prepared], name, free_height)
    notices = [line for folder, lines in prepared for line in (*lines, *spec.notices(folder, free_height))]
    if spec.reads <= {"ranges", "tdoa", "imu", "odometry"}:
        solid = (Trajectories.of(group.trajectories).folders for group in groups if not group.planar)
        rigs = {id(folder.rig): folder.rig for folders in solid for folder in folders}
        notices += dict.fromkeys(line for rig in rigs.values() for line in rig.mirror_notice())
    return [replace(groups[0], notices=tuple(notices)), *groups[1:]] if groups else []


def folder_list(recordings: Recordings) -> list[RecordingFolder]:
    """One recording folder or several as a list; raises UnusableInput for anything else, and for two of one name."""
    arrays = "recordings in arrays are run by a tracker of arrays, as `range_tracker(4).run`"
    folders = one_or_more(recordings, (RecordingFolder,), f"{FOLDERS}; {arrays}")
    refuse_same_names([folder.name for folder in folders])
    return folders


def counted_once(folder: RecordingFolder, names: Collection[str]) -> tuple[RecordingFolder, list[str]]:
    """A recording without duplicate rows and, in `names`, values that a source only repeats; a line for each table."""
    tables, lines = dict[str, pl.DataFrame](), list[str]()
    for name in (n for n in KINDS if n in folder.tables):
        kind, rows = KINDS[name], distinct(folder.tables[name], KINDS[name])
        own = folder
        if duplicates := folder.tables[name].height - rows.height:
            own, line = replace(folder, tables={name: rows}), f"{name}: duplicate rows: {duplicates}; counted once"
            tables[name] = rows
            lines += [f"{folder.name}: {line}"] * (line not in folder.notices)
        if folder.average_s is not None or not kind.averaged or name not in names:
            continue
        if source_repeats(own.streams(name)):
            columns = kind.layout(rows.columns)
            values = [pl.col(column) for column in columns.values]
            same = pl.all_horizontal(x.eq_missing(x.forward_fill().shift().over(columns.ids)) for x in values)
            held = rows.select(same & pl.any_horizontal(x.is_not_null() for x in values)).to_series()
            tables[name] = rows.with_columns(pl.when(~held).then(x) for x in values)
            lines.append(
                f"{folder.name}: {name}: {held.sum()} of {rows.height} rows repeat the value before of the same "
                f"{' and '.join(columns.ids)}, more than by chance; each value is used once (every row: --average 0)"
            )
    return (replace(folder, tables={**folder.tables, **tables}) if tables else folder), lines


def source_repeats(read: Streams) -> bool:
    """Whether readings repeat the one before so often that most repeats are no new readings."""
    if not read.repeated_share >= MANY_REPEATS:
        return False
    steps = np.array([quantisation_step(read, k) or 0.0 for k in range(len(read.columns))])
    clear = (np.abs(read.moved) > CLEAR * steps).any(axis=1)
    # A change follows the one before where the rows of both have a predecessor in one stream.
    after = np.flatnonzero(read.follows[1:] & read.follows[:-1] & clear[:-1]) + 1
    if len(after) < LEAST_PAIRS:
        return False
    share = float(np.mean((read.moved[after] == 0.0).all(axis=1)))
    # All columns repeat at most as often as each of them.
    chance = min((chance_of_repeat(read.moved[after, k], step) for k, step in enumerate(steps)), default=0.0)
    return share >= MANY_REPEATS and share - chance > HELD * share


def quantisation_step(read: Streams, column: int) -> float | None:
    """The quantisation step of a column, in its unit; None where its changes are not multiples of one."""
    x = np.abs(read.moved[:MOST_DIFFERENCES, column][read.follows[:MOST_DIFFERENCES]])
    x = x[np.isfinite(x) & (x > 1e-12 * (1.0 + np.nanmax(np.abs(read.values[:, column]), initial=0.0)))]
    # The coarsest first: a few values off the steps, as means of two, are multiples of half a step.
    for candidate in np.unique(np.quantile(x, QUANTILES, method="lower"))[::-1] if len(x) >= LEAST_VALUES else ():
        multiples = np.round(x / candidate)
        good = (np.abs(x / candidate - multiples) < NEAR) & (multiples > 0)
        if good.mean() >= MULTIPLES:
            return float(x[good].sum() / multiples[good].sum())
    return None


def chance_of_repeat(moved: np.ndarray, step: float) -> float:
    """A bound of P(0) of changes (n,) in steps after a clear one: P(1)²/P(2) if log-concave; 0 without steps."""
    if step == 0.0:
        return 0.0
    one, two = (np.count_nonzero(np.round(np.abs(moved) / step) == k) / 2 for k in (1, 2))
    return one**2 / max(two, 1.0) / len(moved)


def with_rounding(folder: RecordingFolder, names: Collection[str]) -> RecordingFolder:
    """The recording with the rounding's standard deviation, step/√12, for readings of these tables that report none."""
    tables = dict[str, pl.DataFrame]()
    for name in (n for n in KINDS if n in folder.tables and n in names):
        kind, table = KINDS[name], folder.tables[name]
        if kind.averaged and not any(std_column(column) in table.columns for column in kind.least):
            read = (folder.unaveraged or folder).streams(name)
            steps = {column: quantisation_step(read, k) for k, column in enumerate(read.columns)}
            spreads = {std_column(c): pl.lit(step / math.sqrt(12.0)) for c, step in steps.items() if step is not None}
            if spreads:
                tables[name] = table.with_columns(**spreads)
    return replace(folder, tables={**folder.tables, **tables}) if tables else folder


def near_origin(folder: RecordingFolder) -> RecordingFolder:
    """The recording about whole metres in the middle of its site (of most fixes without geometry), unless near zero."""
    rig = folder.rig
    corners = [x for x in (rig.path_knots, rig.outline) if x is not None]
    points = np.concatenate([np.array([p[:2] for p in rig.places()]).reshape(-1, 2), *corners, rig.all_walls()[:, :2]])
    if not len(points) and "fixes" in folder.tables:
        known = folder.tables["fixes"].select("x_m", "y_m").drop_nulls().to_numpy()
        points = np.quantile(known, [0.1, 0.9], axis=0) if len(known) else points
    if len(points):
        points = points[np.abs(points - np.median(points, axis=0)).max(axis=1) < ELSEWHERE_M]
    if not len(points):
        return folder
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.round((low + high) / 2)
    if (np.abs(middle) <= np.maximum(FAR_M, high - low)).all():
        return folder
    x, y = middle.tolist()
    here = {"x_m": pl.col("x_m") - x, "y_m": pl.col("y_m") - y}
    tables = {n: t.with_columns(**here) if table_kinds()[n].position else t for n, t in folder.tables.items()}
    return replace(folder, rig=_moved(rig, middle), tables=tables, origin=(x, y))


def _moved(rig: Rig, origin: np.ndarray) -> Rig:
    """The rig with its x and y from the origin (2,)."""
    solid = np.append(origin, 0.0)
    return replace(
        rig,
        anchors={name: np.asarray(place) - solid for name, place in rig.anchors.items()},
        stations={name: replace(s, position=np.asarray(s.position) - solid) for name, s in rig.stations.items()},
        path_knots=None if rig.path_knots is None else rig.path_knots - origin,
        walls=None if rig.walls is None else rig.walls - np.tile(origin, 2),
        outline=None if rig.outline is None else rig.outline - origin,
    )
