"""Mistakes made on real recordings are named by `check`, and none is named where nobody made one."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import Make, about_z, rotated, with_anchors, with_columns
from trackwright.trackers.recordings.checks.all_checks import quick_check
from trackwright.trackers.recordings.folder import read_recording, write_recording

Mistake = namedtuple("Mistake", "recording words make")  # the words are those of the message that names it


def _swapped(things: dict[str, Any], first: int, second: int) -> dict[str, Any]:
    names = list(things)
    return {names[first]: things[names[second]], names[second]: things[names[first]]}


def _nth(number: int, change: Callable[[np.ndarray], np.ndarray]) -> Make:
    """Another place of one anchor."""
    return with_anchors(lambda anchors: {list(anchors)[number]: change(list(anchors.values())[number])})


def _all_anchors(change: Callable[[np.ndarray], np.ndarray]) -> Make:
    return with_anchors(lambda anchors: {key: change(np.array(place)) for key, place in anchors.items()})


def _cycled(things: dict[str, Any]) -> dict[str, Any]:
    return dict(zip(things, np.roll(np.stack(list(things.values())), 1, axis=0), strict=True))


def _turned(degrees: float) -> Make:
    c, s = float(np.cos(np.radians(degrees))), float(np.sin(np.radians(degrees)))
    return with_columns("truth", x_m=c * X - s * Y, y_m=s * X + c * Y)


T, X, Y, Z = (pl.col(name) for name in ("t_s", "x_m", "y_m", "z_m"))
RANGE, AZIMUTH, ELEVATION = pl.col("range_m"), pl.col("azimuth_rad"), pl.col("elevation_rad")

MISTAKES = {
    "ranges in millimetres": Mistake("starloc-fast-s1", ("millimetres",), with_columns("ranges", range_m=1000 * RANGE)),
    "ranges in centimetres": Mistake("labyrinth", ("centimetres",), with_columns("ranges", range_m=100 * RANGE)),
    "ranges in feet": Mistake("iasl-drone-1", ("ranges", "feet"), with_columns("ranges", range_m=RANGE / 0.3048)),
    "round-trip distances": Mistake("labyrinth", ("round-trip",), with_columns("ranges", range_m=2 * RANGE)),
    "an antenna delay": Mistake(
        "starloc-2d-s5", ("offset of the ranges",), with_columns("ranges", range_m=RANGE + 3.0)
    ),
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
        "labyrinth", ("rig.toml", "millimetres"),
        _all_anchors(lambda place: 1000 * place),
    ),
    "anchors in feet": Mistake("lias-planar-fast", ("rig.toml in feet",), _all_anchors(lambda place: place / 0.3048)),
    "x and y of the truth swapped": Mistake("rcv-drone-3", ("read as y, x, z",), with_columns("truth", x_m=Y, y_m=X)),
    "y of the truth flipped": Mistake("tiers-1tag-01", ("read as x, -y, z",), with_columns("truth", y_m=-Y)),
    "truth with z downward": Mistake("tiers-2tag-01", ("read as y, x, -z",), with_columns("truth", x_m=Y, y_m=X, z_m=-Z)),
    "truth turned": Mistake("lias-planar-fast", ("turned by 37.",), _turned(-37.0)),
    "truth turned against stations": Mistake("ble51-walk-u1-r1", ("of the truth",), _turned(90.0)),
    "truth 100 m off": Mistake("starloc-fast-s1", ("shifted by (-99.", "origin"), with_columns("truth", x_m=X + 100)),
    "truth 2 m off": Mistake("tiers-2tag-06", ("shifted by", "origin"), with_columns("truth", y_m=Y + 2)),
    "truth off against stations": Mistake("ble51-walk-u2-r1", ("shifted by", "origin"), with_columns("truth", x_m=X + 4)),
    "truth in centimetres": Mistake("labyrinth", ("truth", "centimetres"), with_columns("truth", x_m=100 * X, y_m=100 * Y, z_m=100 * Z)),
    "truth 5 s late": Mistake("tiers-2tag-01", ("clock",), with_columns("truth", t_s=T + 5.0)),
    "truth 18 s early": Mistake("rcv-drone-3", ("clock",), with_columns("truth", t_s=T - 18.0)),
    "truth 4 s late against stations": Mistake("ble51-walk-u1-r2", ("clock",), with_columns("truth", t_s=T + 4.0)),
    "truth in another time zone": Mistake("ngbui-line-1-1", ("time zones",), with_columns("truth", t_s=T + 7200.0)),
    "fixes in feet": Mistake(
        "tiers-2tag-03", ("feet",), with_columns("fixes", x_m=X / 0.3048, y_m=Y / 0.3048, z_m=Z / 0.3048)
    ),
    "x of the fixes flipped": Mistake("tiers-2tag-03", ("read as -x, y, z",), with_columns("fixes", x_m=-X)),
    "the azimuth's sign": Mistake("ble51-walk-u1-r1", ("sign of the azimuth",), with_columns("bearings", azimuth_rad=-AZIMUTH)),
    "the elevation's sign": Mistake("ble51-walk-u2-r2", ("sign of the elevation",), with_columns("bearings", elevation_rad=-ELEVATION)),
    "azimuth and elevation swapped": Mistake(
        "ble51-walk-u1-r2", ("azimuth and elevation swapped",), with_columns("bearings", azimuth_rad=ELEVATION, elevation_rad=AZIMUTH)
    ),
    "degrees": Mistake(
        "ble51-walk-u3-r1", ("degrees",), with_columns("bearings", azimuth_rad=AZIMUTH.degrees(), elevation_rad=ELEVATION.degrees())
    ),
    "two stations swapped": Mistake(
        "ble51-walk-u3-r2", ("swapped for", "ids of stations"),
        lambda folder: replace(
            folder, rig=replace(folder.rig, stations={**folder.rig.stations, **_swapped(dict(folder.rig.stations), 0, 1)})
        ),
    ),
    "quaternions as x, y, z, w": Mistake("ble51-walk-u2-r2", ("x, y, z, w",), rotated(lambda q: np.roll(q, -1))),
    "quaternions inverted": Mistake("ble51-walk-u1-r1", ("inverted",), rotated(lambda q: q * [1, -1, -1, -1])),
    "one station turned": Mistake(
        "ble51-walk-u3-r1", ("another orientation",),
        rotated(lambda q: about_z(q, 90.0), ("6503",)),
    ),
}  # fmt: skip
QUICK = ("ranges in centimetres", "round-trip distances", "x of the fixes flipped", "the azimuth's sign")


def _message(mistake: Mistake, recordings: Path, folder: Path) -> str:
    """All errors that `check` finds in a copy of the recording with the mistake."""
    write_recording(mistake.make(read_recording(recordings / mistake.recording)), folder)
    return "; ".join(f"{result.where} {result.message}" for result in quick_check(read_recording(folder)))


@pytest.mark.parametrize("name", QUICK)
def test_a_mistake_on_a_small_recording_is_named(recordings, tmp_path, name):
    message = _message(MISTAKES[name], recordings, tmp_path / "made")
    assert all(word in message for word in MISTAKES[name].words), message


@pytest.mark.slow
def test_nine_of_ten_mistakes_on_real_recordings_are_named(recordings, tmp_path):
    found = {name: _message(one, recordings, tmp_path / str(k)) for k, (name, one) in enumerate(MISTAKES.items())}
    missed = {
        f"{name} ({MISTAKES[name].recording})": message
        for name, message in found.items()
        if not all(word in message for word in MISTAKES[name].words)
    }
    for name, message in missed.items():
        print(f"missed: {name}: {message}")
    assert len(MISTAKES) >= 20
    assert len(missed) <= len(MISTAKES) // 10
