"""What the command line knows of a tracker: its name's entry, and the lanes that one tracker runs together."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

import polars as pl

from trackers.core.tracker import AbstractTracker
from trackers.recordings.folder import Folder
from trackers.recordings.trajectories import Lane, known_height


@dataclass(frozen=True)
class Group:
    """Lanes that one tracker runs as a batch; `planar`: in the floor plane at known heights, or in an array's plane."""

    tracker: AbstractTracker
    lanes: list[Lane]
    planar: bool


def at_known_height(lane: Lane, free_height: bool) -> bool:
    """Whether a tag's height is known and to be used, so that it is tracked over the floor alone."""
    return not free_height and known_height(lane.folder, lane.tag) is not None


def on_request(folder: Folder) -> bool:
    """Never: such a tracker is taken only where it is named."""
    return False


@dataclass(frozen=True)
class Entry:
    """A tracker by name.

    `table`: what it reads. `lacks`: what a folder lacks for it, in words, or None where it fits. `lanes`: the lanes of
    a folder; the flag is --free-height. `build`: the tracker of a lane; the flag is `planar` of that lane. `geometry`:
    what of a lane is part of its tracker; lanes that agree in it, and in `planar`, share one. `automatic`: whether it
    is taken for a folder that it fits where no tracker is named. `bearing_only`: whether it estimates directions.
    `events`: what happened in a lane, from its rows of the tracks table: time s, event, detail; None where only lost
    tracks are told.
    """

    about: str
    table: str
    lacks: Callable[[Folder], str | None]
    lanes: Callable[[Folder, bool], Iterator[Lane]]
    build: Callable[[Lane, bool], AbstractTracker]
    geometry: Callable[[Lane], Hashable] = lambda lane: ()
    planar: Callable[[Lane, bool], bool] = at_known_height
    automatic: Callable[[Folder], bool] = lambda folder: True
    bearing_only: bool = False
    events: Callable[[Lane, pl.DataFrame], list[tuple[float, str, str]]] | None = None
