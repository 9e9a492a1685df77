"""The studies of the work stand compute what they claim from the fitted array, and the fits are what they say."""

from dataclasses import replace

import numpy as np
import pytest

from trackwright.experiments.lab.papers.fitting import fitted, unsaved
from trackwright.experiments.lab.papers.will_2020 import computing_cost, figure_8
from trackwright.experiments.lab.papers.will_2020 import table_1 as of_table_1
from trackwright.experiments.lab.papers.will_2020._work_stand import (
    HALF_BOX,
    NUMBERS,
    PRINTED_DEG,
    RADIUS,
    SETS,
    antennas_of,
    recorded,
    stand,
)
from trackwright.experiments.monte_carlo import ExpectedResult
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.trackers.aoa.phases import DEFAULT_WAVELENGTH


@pytest.fixture(scope="module")
def table_1():
    study = load_study("table-1")
    return unsaved(replace(study, runs=8, trackers={"EKF": study.trackers["EKF"]}, metrics=()))


def test_the_fitted_array_keeps_to_its_box_and_half_a_wavelength_apart():
    antennas = antennas_of(NUMBERS)
    # Written to 0.01 mm, fitted with a tenth of a millimetre to spare.
    assert np.all(np.abs(antennas) <= HALF_BOX + 1e-5)
    apart = np.linalg.norm(antennas[:, None] - antennas, axis=-1)[np.triu_indices(8, 1)]
    assert apart.min() >= DEFAULT_WAVELENGTH / 2 - 1e-5


@pytest.mark.slow
def test_the_fitted_parameters_give_the_deviations_in_their_files():
    # Seeded, so the same but for the order of sums: 0.1 % of an error.
    assert of_table_1.worst(NUMBERS) == pytest.approx(NUMBERS["worst"], abs=1e-3)
    assert 3.18 * figure_8.SEARCH.ratios({"radius": RADIUS})[0] == pytest.approx(
        fitted("papers/will_2020/figure_8")["error"], rel=1e-3
    )


@pytest.mark.slow
def test_the_fit_judges_tracks_as_the_study_does(table_1):
    found = of_table_1.errors(NUMBERS, 8, 0, True, RADIUS)
    for name, (azimuth, elevation) in zip(SETS, found, strict=True):
        # Same worlds, same tracker, other code: single precision and a table of decimal phases between.
        assert np.rad2deg(table_1.value("rmse_azimuth_rad", name, "EKF").value) == pytest.approx(azimuth, rel=1e-3)
        assert np.rad2deg(table_1.value("rmse_elevation_rad", name, "EKF").value) == pytest.approx(elevation, rel=1e-3)


def test_operations_are_those_counted_by_hand_and_do_not_depend_on_the_machine():
    station = next(iter(stand(NUMBERS).stations.values()))
    # Of a hypothesis: four scalar products of eight, two sums, two squares and their sum; the search for the largest
    # takes up to ten more.
    for resolution, hypotheses in ((1.2, 51**2), (0.6, 101**2), (0.3, 201**2)):
        each = computing_cost.search_operations(station, resolution) / hypotheses
        assert 4 * 2 * 8 + 5 <= each <= 4 * 2 * 8 + 15
    # The paper's filter would invert a matrix of 28 × 28 in every row.
    assert 500 < computing_cost.filter_operations(station) < 28**3 / 3


def test_a_lost_station_says_nothing_and_the_helix_takes_as_long_at_any_rate():
    phases = recorded(np.array([3, 5]), 0, lost=1, rate_hz=2.0).tables["phases"]
    assert sorted(phases["station"].unique()) == ["2", "3"]
    assert sorted(phases["tag"].unique()) == ["3", "5"]
    assert phases["t_s"].max() == pytest.approx(19.5)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.2, 0.4])
def test_where_the_stations_stand_matters_little_for_the_table(radius):
    found = of_table_1.errors(NUMBERS, 64, 0, True, radius)
    assert found == pytest.approx(np.array(list(PRINTED_DEG.values())), rel=0.1)


@pytest.mark.slow
def test_all_printed_errors_are_reached_within_a_tenth():
    for name, count in (("table-1", 10), ("figure-8", 1)):
        results = unsaved(replace(load_study(name), runs=100))
        expected = [one for one in results.study.expected(results) if isinstance(one, ExpectedResult)]
        asked = [one for one in expected if one.within is not None]
        assert len(asked) == count
        assert all(one.reached for one in asked)
