"""Mistakes made on simulated phases, and on real ones, are named by `check`; none is named on sound recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.trackers.recordings.checks.made import Make, about_z, rotated, with_columns, with_stations
from trackwright.sim import worlds
from trackwright.trackers.recordings.checks.all_checks import check, quick_check
from trackwright.trackers.recordings.folder import read_recording

SIGMA_P = 0.3
PHASES = [f"phase_{k}_rad" for k in range(1, 9)]


@pytest.fixture(scope="module")
def sound():
    return worlds.station(n=2, seed=2, rows=80, sigma_p=SIGMA_P).folder()


def _each(change: Callable[[pl.Expr], pl.Expr]) -> Make:
    return with_columns("phases", **{name: change(pl.col(name)) for name in PHASES})


def _columns(order: list[str]) -> Make:
    return with_columns("phases", **{name: pl.col(other) for name, other in zip(PHASES, order, strict=True)})


def _wavelength(factor: float) -> Make:
    return with_stations(lambda station: replace(station, wavelength=factor * station.wavelength))


def _antennas(factor: float | list[float]) -> Make:
    return with_stations(lambda station: replace(station, antennas=np.multiply(station.antennas, factor)))


SWAPPED = [PHASES[{1: 4, 4: 1}.get(k, k)] for k in range(8)]
MISTAKES = {
    "the sign": (_each(lambda phase: -phase), "sign of the phases flipped"),
    "degrees, wrapped": (_each(lambda phase: phase.degrees()), "degrees"),
    "turns": (_each(lambda phase: phase / (2 * np.pi)), "phases in turns"),
    "two antennas swapped": (_columns(SWAPPED), "phases 2 and 5 exchanged"),
    "the antennas in reverse order": (_columns(PHASES[::-1]), "antennas in reverse order"),
    "the antennas counted from another one": (_columns([*PHASES[1:], PHASES[0]]), "phase_1_rad as that of antenna 2"),
    "a wavelength 1.3 times too long": (_wavelength(1.3), "wavelength_m"),
    "half the wavelength": (_wavelength(0.5), "another wavelength"),
    "the wavelength in millimetres": (_wavelength(1000), "wavelength_m in millimetres"),
    "antennas in centimetres": (_antennas(100), "antennas_m in centimetres"),
    "antennas seen from behind": (_antennas([-1.0, 1.0]), "x of antennas_m flipped"),
    "quaternions as x, y, z, w": (rotated(lambda q: np.roll(q, -1)), "x, y, z, w"),
    "quaternions inverted": (rotated(lambda q: q * [1, -1, -1, -1], ("2", "3")), "inverted"),
    "one station turned": (rotated(lambda q: about_z(q, 40.0), ("2",)), "station 2 (by -40°)"),
    "truth of another origin": (with_columns("truth", x_m=pl.col("x_m") + 1.5), "truth shifted by (-1.5"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_with_the_errors_that_remain_without_it(sound, name):
    make, words = MISTAKES[name]
    errors = quick_check(make(sound))
    assert len(errors) == 1
    assert words in errors[0].message, errors[0].message
    assert errors[0].where == "phases"


def test_sound_phases_have_no_error_and_a_line_for_each_station(sound):
    results = check(sound)
    assert [result for result in results if result.level == "error"] == []
    lines = [result.message for result in results if "against truth" in result.message]
    assert len(lines) == 3
    for number, line in enumerate(lines, 1):
        assert line.startswith(f"station {number} against truth: offsets of antennas")
        # The mean of a row takes an eighth of the variance away.
        spread = float(line.partition("spread ")[2].split(" rad")[0])
        assert spread == pytest.approx(SIGMA_P * np.sqrt(7 / 8), rel=0.1)


def test_a_station_that_gives_angles_and_missing_phases_are_left_out(sound):
    rig = replace(sound.rig, stations={**sound.rig.stations, "4": replace(sound.rig.stations["1"], antennas=None)})
    fewer = replace(sound.rig.stations["3"], antennas=np.asarray(sound.rig.stations["3"].antennas)[:6])
    rig = replace(rig, stations={**rig.stations, "3": fewer})
    missing = {
        name: pl.when(pl.col("station") == "3").then(None).otherwise(pl.col(name)).alias(name) for name in PHASES[6:]
    }
    phases = sound.tables["phases"].with_columns(**missing)
    folder = replace(sound, rig=rig, tables={**sound.tables, "phases": phases})
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
