"""A tracker by name that runs on recording folders: the catalogue's entry with noise levels and settings.

Recordings in map coordinates are tracked about an origin nearby: single precision resolves 5e6 m to half a metre.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput, one_or_more
from trackwright.trackers.core.model.rig import ELSEWHERE_M, Rig
from trackwright.trackers.core.model.tunable import AbstractTunable, tunables, with_values
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.kinds import table_kinds
from trackwright.trackers.recordings.reading_grids import counted_once, with_rounding
from trackwright.trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec, faults_named
from trackwright.trackers.recordings.tracks import Tracks, track
from trackwright.trackers.recordings.trajectories import Trajectories

Recordings = RecordingFolder | Sequence[RecordingFolder]

FAR_M = 1000.0
"""Distance of x or y from zero, m, from which on coordinates are a map's if it is also larger than the site."""

FEW_GAPS = 3
"""Long gaps between epochs that make a rule."""


@dataclass(frozen=True, repr=False)
class NamedTracker:
    """A tracker of the catalogue, or a user's own, for recording folders.

    `tracker`: the tracker of the first trajectory of the recordings it was made for. `side`: above or below, where tags
    are of anchors in one plane. `values`: physical numbers by tunable name or shell pattern that replace the defaults
    in every recording; `source`: where they come from, for messages. `smoothed`: whether each row uses the later rows,
    too, `lag` seconds of them or all. A recording with other stations or anchors gets a tracker of its own geometry
    with the same numbers. `made_for`: the recordings that it was made for and their rows, made only once.
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
        """The estimates of every tag of one recording or several; `advance` gets the number of trajectories done.

        `seed`: of the random numbers of filters that draw any. Raises UnusableInput for a recording that lacks what the
        tracker reads, and for values that do not fit it.
        """
        return self.track(self.batches(recordings), advance, seed=seed)

    def track(
        self, batches: Sequence[TrackerBatch], advance: Callable[[int], None] = lambda done: None, *, seed: int = 0
    ) -> Tracks:
        """The estimates of `batches`, as `run`."""
        with faults_named(self.name, "run", self.spec.build):
            return track(batches, advance, seed)

    def batches(self, recordings: Recordings) -> list[TrackerBatch]:
        """The trajectories of the recordings and the trackers that run them, with this tracker's numbers.

        Values that a source repeats are used once: `TrackerBatch.notices`. Recordings in map coordinates are about an
        origin nearby, `trajectory.folder.origin`; estimates of `run` are not.
        """
        groups = self._batches(recordings)
        return [replace(g, tracker=self._finished(g.tracker), notices=(*g.notices, *rare_epochs(g))) for g in groups]

    def _batches(self, recordings: Recordings) -> list[TrackerBatch]:
        """The batches with this tracker's numbers as they are, not smoothed."""
        folders = folder_list(recordings)
        made_for, groups = self.made_for
        # Rows of long recordings take longer to make than to filter.
        if len(folders) != len(made_for) or any(a is not b for a, b in zip(folders, made_for, strict=True)):
            groups = _batches(self.spec, folders, self.name, self.free_height, self.side)
        return [replace(group, tracker=with_values(group.tracker, self.values, self.source)) for group in groups]

    def only_batch(self, recordings: Recordings) -> TrackerBatch:
        """All trajectories of the recordings for one and the same tracker, as a fit needs them.

        Raises UnusableInput where they need several: those have no numbers in common.
        """
        groups = self._batches(recordings)
        if len(groups) != 1:
            raise self._several(len(groups))
        return replace(groups[0], tracker=self._finished(groups[0].tracker))

    def _several(self, count: int) -> UnusableInput:
        return UnusableInput(
            f"the recordings need {count} different '{self.name}' trackers (other geometry, or heights known "
            "for some tags only); expected one; take them apart, or estimate all heights (free_height)"
        )

    @property
    def tunables(self) -> dict[str, AbstractTunable]:
        """The numbers that can be tuned, by name."""
        return tunables(self.tracker)

    def with_values(self, values: Mapping[str, Any], source: object = "values") -> NamedTracker:
        """This tracker with other values by tunable name or pattern; raises UnusableInput where they do not fit."""
        tracker = with_values(self.tracker, values, source)
        return replace(self, tracker=tracker, values={**self.values, **values}, source=str(source))

    def smoothing(self, lag: float | None = None) -> NamedTracker:
        """This tracker with fixed-interval smoothing, or with the next `lag` seconds of each row only.

        Raises UnusableInput for a lag that is no positive number, and for trackers without a smoother.
        """
        if lag is not None and not 0 < lag < 1e6:
            raise UnusableInput(f"lag {lag}: expected seconds above zero; leave it out to use the whole recording")
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
                raise UnusableInput(
                    f"tracker '{self.name}' cannot be smoothed: {error}; run it without smoothing"
                ) from error
        finished: AbstractTracker = tracker
        return finished

    def __repr__(self) -> str:
        smoothed = f", smoothed over {self.lag:g} s" if self.lag else ", smoothed" if self.smoothed else ""
        return f"<tracker {self.name}: {self.spec.about}{smoothed}; tunables {', '.join(self.tunables)}>"


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


def rare_epochs(batch: TrackerBatch) -> list[str]:
    """A line where at least half of a track's time lies in gaps of the rows beyond the tracker's `max_gap`."""
    limit = float(batch.tracker.track_loss.max_gap.value) if hasattr(batch.tracker, "track_loss") else np.inf
    lines = []
    for trajectory in batch.trajectories:
        gaps = np.diff(trajectory.recording.times)
        long = gaps[gaps > limit]
        if len(long) >= FEW_GAPS and long.sum() > gaps.sum() / 2:
            lines.append(
                f"{trajectory.folder.name}: tag {trajectory.tag}: epochs are typically {np.median(long):.3g} s apart, "
                f"more than track_loss.max_gap ({limit:g} s), so that each starts a new track; where the tag "
                f"moves little in between, --set track_loss.max_gap={3 * np.median(long):.3g} keeps one"
            )
    return lines


def folder_list(recordings: Recordings) -> list[RecordingFolder]:
    """One recording folder or several as a list; raises UnusableInput for anything else, and for two of one name."""
    arrays = "recordings in arrays are run by a tracker of arrays, as `range_tracker(4).run`"
    folders = one_or_more(recordings, (RecordingFolder,), f"{FOLDERS}; {arrays}")
    refuse_same_names([folder.name for folder in folders])
    return folders


def near_origin(folder: RecordingFolder) -> RecordingFolder:
    """The recording about an origin of whole metres in the middle of its site, or as it is if that is near zero.

    The site is the rig's, or, where this has no geometry, of most fixes. Heights are unchanged.
    """
    points = _site(folder)
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
    kinds = table_kinds()
    tables = {name: t.with_columns(**here) if kinds[name].position else t for name, t in folder.tables.items()}
    return replace(folder, rig=_moved(folder.rig, middle), tables=tables, origin=(x, y))


def _site(folder: RecordingFolder) -> np.ndarray:
    """Points (n, 2), m, on and between which the tags are; none where neither the rig nor fixes tell."""
    rig = folder.rig
    corners = [x for x in (rig.path_knots, rig.outline) if x is not None]
    points = np.concatenate([np.array([p[:2] for p in rig.places()]).reshape(-1, 2), *corners, rig.all_walls()[:, :2]])
    if len(points) or "fixes" not in folder.tables:
        return points
    known = folder.tables["fixes"].select("x_m", "y_m").drop_nulls().to_numpy()
    return np.quantile(known, [0.1, 0.9], axis=0) if len(known) else points


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
