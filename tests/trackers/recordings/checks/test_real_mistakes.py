"""Mistakes made on real recordings are named by `check`, and none is named where nobody made one."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import Make, about_z, rotated, with_anchors, with_columns
from trackwright.trackers.recordings.checks.all_checks import quick_check
from trackwright.trackers.recordings.folder import read_recording

Mistake = namedtuple("Mistake", "recording words make")  # the words are those of the message that names it


def _swapped(things: dict[str, Any], first: int, second: int) -> dict[str, Any]:
    names = list(things)
    return {names[first]: things[names[second]], names[second]: things[names[first]]}


def _nth(number: int, change: Callable[[np.ndarray], np.ndarray]) -> Make:
    """Another place of one anchor."""
    return with_anchors(lambda anchors: {list(anchors)[number]: change(list(anchors.values())[number])})


def _cycled(things: dict[str, Any]) -> dict[str, Any]:
    return dict(zip(things, np.roll(np.stack(list(things.values())), 1, axis=0), strict=True))


def _turned(degrees: float) -> Make:
    c, s = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
    return with_columns("truth", x_m=c * X - s * Y, y_m=s * X + c * Y)


T, X, Y, Z = (pl.col(name) for name in ("t_s", "x_m", "y_m", "z_m"))
RANGE, AZIMUTH = pl.col("range_m"), pl.col("azimuth_rad")

MISTAKES = {
    "ranges in millimetres": Mistake("starloc-fast-s1", ("millimetres",), with_columns("ranges", range_m=1000 * RANGE)),
    "ranges in feet": Mistake("iasl-drone-1", ("ranges", "feet"), with_columns("ranges", range_m=RANGE / 0.3048)),
    "an antenna delay of one anchor": Mistake(
        "lias-planar-fast", ("offset of the ranges", "anchor 3"),
        with_columns("ranges", range_m=pl.when(pl.col("anchor") == "3").then(RANGE + 2.5).otherwise(RANGE)),
    ),
    "two anchors swapped": Mistake(
        "iasl-drone-1", ("swapped for", "ids of anchors"), with_anchors(lambda anchors: _swapped(anchors, 1, 6))
    ),
    "anchors named one too high": Mistake("starloc-2d-s5", ("ids of anchors",), with_anchors(_cycled)),
    "an anchor at a wrong place": Mistake(
        "starloc-fast-s1", ("wrong position",), _nth(2, lambda place: place + [1.5, -1.0, 0.0])
    ),
    "the sign of an anchor's x": Mistake(
        "rcv-drone-3", ("wrong position",),
        _nth(0, lambda place: place * [-1.0, 1.0, 1.0]),
    ),
    "anchors in millimetres": Mistake(
        "labyrinth", ("anchors", "millimetres"),
        with_anchors(lambda anchors: {key: 1000 * np.array(place) for key, place in anchors.items()}),
    ),
    "truth with z downward": Mistake("tiers-2tag-01", ("read as y, x, -z",), with_columns("truth", x_m=Y, y_m=X, z_m=-Z)),
    "truth turned": Mistake("lias-planar-fast", ("turned by 37.",), _turned(-37.0)),
    "truth 100 m off": Mistake("starloc-fast-s1", ("shifted by (-99."), with_columns("truth", x_m=X + 100)),
    "truth 2 m off": Mistake("tiers-2tag-06", ("shifted by"), with_columns("truth", y_m=Y + 2)),
    "truth 5 s late": Mistake("tiers-2tag-01", ("clock",), with_columns("truth", t_s=T + 5.0)),
    "the azimuth's sign": Mistake("ble51-walk-u1-r1", ("sign of the azimuth",), with_columns("bearings", azimuth_rad=-AZIMUTH)),
    "two stations swapped": Mistake(
        "ble51-walk-u3-r2", ("swapped for", "ids of stations"),
        lambda folder: replace(
            folder, rig=replace(folder.rig, stations={**folder.rig.stations, **_swapped(dict(folder.rig.stations), 0, 1)})
        ),
    ),
    "one station turned": Mistake(
        "ble51-walk-u3-r1", ("another orientation",),
        rotated(lambda q: about_z(q, 90.0), ("6503",)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)], ids=["every ninth", "all"])
def test_mistakes_on_real_recordings_are_named(recordings, every):
    missed = dict[str, list[str]]()
    for name, one in list(MISTAKES.items())[::every]:
        made = one.make(read_recording(recordings / one.recording))
        made = replace(made, tables={k: t.sort("t_s", maintain_order=True) for k, t in made.tables.items()})
        found = [result.message for result in quick_check(made)]
        missed |= {} if all(any(word in line for line in found) for word in one.words) else {name: found}
    assert missed == {}
