"""A tracker by name that runs on recording folders: the catalogue's entry with noise levels and settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from trackwright.trackers.core.errors import UnusableInput, one_or_more
from trackwright.trackers.core.model.tunable import AbstractTunable, tunables, with_values
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.local_frame import near_origin
from trackwright.trackers.recordings.reading_grids import above_rounding
from trackwright.trackers.recordings.tracker_spec import TrackerBatch, TrackerSpec
from trackwright.trackers.recordings.tracks import Tracks, track

Recordings = RecordingFolder | Sequence[RecordingFolder]


@dataclass(frozen=True, repr=False)
class NamedTracker:
    """A tracker of the catalogue, or a user's own, for recording folders.

    `tracker`: the tracker of the first trajectory of the recordings it was made for. `values`: physical numbers by
    tunable name or shell pattern that replace the defaults in every recording; `source`: where they come from, for
    messages. `smoothed`: whether each row uses the later rows, too, `lag` seconds of them or all. A recording with
    other stations or anchors gets a tracker of its own geometry with the same numbers. `made_for`: the recordings that
    it was made for and their rows, which are made only once.
    """

    name: str
    spec: TrackerSpec
    tracker: AbstractTracker
    free_height: bool = False
    values: Mapping[str, Any] = field(default_factory=dict)
    source: str = "values"
    smoothed: bool = False
    lag: float | None = None
    made_for: tuple[list[RecordingFolder], list[TrackerBatch]] = field(default_factory=lambda: ([], []))

    @classmethod
    def of(cls, name: str, spec: TrackerSpec, recordings: Recordings, free_height: bool = False) -> NamedTracker:
        """The tracker of an entry for recordings; raises UnusableInput for a recording that lacks what it reads."""
        folders = folder_list(recordings)
        groups = spec.batches([*map(near_origin, folders)], name, free_height)
        if not groups:
            raise UnusableInput(f"tracker '{name}': no trajectory in the recordings; expected one tag at least")
        return cls(name, spec, groups[0].tracker, free_height, made_for=(folders, groups))

    def run(
        self, recordings: Recordings, advance: Callable[[int], None] = lambda done: None, *, seed: int = 0
    ) -> Tracks:
        """The estimates of every tag of one recording or several; `advance` gets the number of trajectories done.

        `seed`: of the random numbers of filters that draw any. Raises UnusableInput for a recording that lacks what the
        tracker reads, and for values that do not fit it.
        """
        return track(self.batches(recordings), advance, seed)

    def batches(self, recordings: Recordings) -> list[TrackerBatch]:
        """The trajectories of the recordings and the trackers that run them, with this tracker's numbers.

        A noise level below the rounding of a recording's readings is raised to it: `TrackerBatch.notices`. Recordings
        in map coordinates are about an origin nearby, `trajectory.folder.origin`; estimates of `run` are not.
        """
        groups = self._batches(recordings)
        split = [part for group in groups for part in above_rounding(group)]
        return [dataclasses.replace(group, tracker=self._finished(group.tracker)) for group in split]

    def _batches(self, recordings: Recordings) -> list[TrackerBatch]:
        """The batches with this tracker's numbers as they are, not smoothed."""
        folders = folder_list(recordings)
        own, groups = self.made_for
        # Rows of long recordings take longer to make than to filter.
        if len(folders) != len(own) or any(a is not b for a, b in zip(folders, own, strict=True)):
            groups = self.spec.batches([*map(near_origin, folders)], self.name, self.free_height)
        return [
            dataclasses.replace(group, tracker=with_values(group.tracker, self.values, self.source)) for group in groups
        ]

    def only_batch(self, recordings: Recordings) -> TrackerBatch:
        """All trajectories of the recordings for one and the same tracker, as a fit needs them.

        Raises UnusableInput where they need several: those have no numbers in common.
        """
        groups = self._batches(recordings)
        if len(groups) != 1:
            raise self._several(len(groups))
        return dataclasses.replace(groups[0], tracker=self._finished(groups[0].tracker))

    def batch_by_batch(self, recordings: Iterable[RecordingFolder]) -> Iterator[TrackerBatch]:
        """As `only_batch`, the trajectories of one recording at a time; a recording without any is passed over."""
        kinds = set()
        for folder in recordings:
            for group in self._batches(folder):
                kinds.add((group.planar, self.spec.geometry(group.trajectories[0])))
                if len(kinds) > 1:
                    raise self._several(len(kinds))
                yield dataclasses.replace(group, tracker=self._finished(group.tracker))

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
        found = with_values(self.tracker, values, source)
        return dataclasses.replace(self, tracker=found, values={**self.values, **values}, source=str(source))

    def smoothing(self, lag: float | None = None) -> NamedTracker:
        """This tracker with fixed-interval smoothing, or with the next `lag` seconds of each row only.

        Raises UnusableInput for a lag that is no positive number, and for trackers without a smoother.
        """
        if lag is not None and not 0 < lag < 1e6:
            raise UnusableInput(f"lag {lag}: expected seconds above zero; leave it out to use the whole recording")
        self._smoother(self.tracker, lag)
        return dataclasses.replace(self, smoothed=True, lag=lag)

    def _finished(self, tracker: AbstractTracker) -> AbstractTracker:
        return self._smoother(tracker, self.lag) if self.smoothed else tracker

    def _smoother(self, tracker: AbstractTracker, lag: float | None) -> AbstractTracker:
        try:
            return Smoothed(tracker, lag)  # type: ignore[arg-type]
        except TypeError as error:
            raise UnusableInput(
                f"tracker '{self.name}' cannot be smoothed: {error}; run it without smoothing"
            ) from error

    def __repr__(self) -> str:
        smoothed = f", smoothed over {self.lag:g} s" if self.lag else ", smoothed" if self.smoothed else ""
        return f"<tracker {self.name}: {self.spec.about}{smoothed}; tunables {', '.join(self.tunables)}>"


def folder_list(recordings: Recordings) -> list[RecordingFolder]:
    """One recording folder or several as a list; raises UnusableInput for anything else, and for two of one name."""
    found = one_or_more(
        recordings,
        (RecordingFolder,),
        "one or more recording folders, as `read`, `read_all` and `world.folder()` return them; recordings in arrays "
        "are run by a tracker of arrays, as `range_tracker(4).run`",
    )
    refuse_same_names([folder.name for folder in found])
    return found
