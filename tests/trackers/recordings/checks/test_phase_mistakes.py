"""Mistakes made on simulated phases, and on real ones, are named by `check`; none is named on sound recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import Make, arrays, with_columns, with_stations
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import read_recording

SIGMA_P = 0.3
PHASES = [f"phase_{k}_rad" for k in range(1, 9)]


def _each(change: Callable[[pl.Expr], pl.Expr]) -> Make:
    return with_columns("phases", **{name: change(pl.col(name)) for name in PHASES})


def _columns(order: list[str]) -> Make:
    return with_columns("phases", **{name: pl.col(other) for name, other in zip(PHASES, order, strict=True)})


def _wavelength(factor: float) -> Make:
    return with_stations(lambda station: replace(station, wavelength=factor * station.wavelength))


def _antennas(factor: float | list[float]) -> Make:
    return with_stations(lambda station: replace(station, antennas=np.multiply(station.antennas, factor)))


SWAPPED = [PHASES[{1: 4, 4: 1}.get(k, k)] for k in range(8)]


def test_sound_phases_have_no_error_and_a_line_for_each_station():
    results = check(arrays())
    assert [result for result in results if result.level == "error"] == []
    lines = [result.message for result in results if "against truth" in result.message]
    assert len(lines) == 3
    for number, line in enumerate(lines, 1):
        assert line.startswith(f"station {number} against truth: offsets of antennas")
        # The mean of a row takes an eighth of the variance away.
        spread = float(line.partition("spread ")[2].split(" rad")[0])
        assert spread == pytest.approx(SIGMA_P * np.sqrt(7 / 8), rel=0.1)


def test_a_station_that_gives_angles_and_missing_phases_are_left_out():
    rig = replace(
        arrays().rig, stations={**arrays().rig.stations, "4": replace(arrays().rig.stations["1"], antennas=None)}
    )
    fewer = replace(arrays().rig.stations["3"], antennas=np.asarray(arrays().rig.stations["3"].antennas)[:6])
    rig = replace(rig, stations={**rig.stations, "3": fewer})
    missing = {
        name: pl.when(pl.col("station") == "3").then(None).otherwise(pl.col(name)).alias(name) for name in PHASES[6:]
    }
    phases = arrays().tables["phases"].with_columns(**missing)
    folder = replace(arrays(), rig=rig, tables={**arrays().tables, "phases": phases})
    assert quick_check(folder) == []
    assert sum("against truth" in result.message for result in check(folder)) == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: folder, None),
        (_columns(SWAPPED), "phases 2 and 5 exchanged"),
        (_columns(PHASES[::-1]), "antennas in reverse order"),
        (_each(lambda phase: phase.degrees()), "degrees"),
        (_wavelength(1000), "wavelength_m in millimetres"),
        (_antennas([-1.0, 1.0]), "x of antennas_m flipped"),
    ],
    ids=["sound", "swapped", "reversed", "degrees", "wavelength", "mirrored"],
)
def test_mistakes_on_recorded_phases_of_a_circular_array_are_named(recordings, make, words):
    errors = quick_check(make(read_recording(recordings / "ble51-uca-x3y3")))
    assert [words in error.message for error in errors] == ([] if words is None else [True])
