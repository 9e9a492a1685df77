"""The fitted array: its bounds have Table 1's ratios, and the fit still finds it."""

import itertools

import numpy as np
import pytest

from trackwright.experiments.lab.papers.will_2020._work_stand import (
    ALL,
    PRINTED_DEG,
    SETS,
    SMALLEST_SPACING,
    fitted_layout,
    in_use,
)
from trackwright.trackers.aoa.phases import DEFAULT_ANTENNAS, DEFAULT_WAVELENGTH, boresight_bounds


def _bounds_by_pseudo_inverse(antennas):
    """Both bounds for unit phase noise from all pairwise differences and their singular covariance."""
    pairs = list(itertools.combinations(range(len(antennas)), 2))
    difference = np.zeros((len(pairs), len(antennas)))
    for row, (i, j) in enumerate(pairs):
        difference[row, [i, j]] = 1, -1
    jacobian = difference @ (2 * np.pi / DEFAULT_WAVELENGTH * antennas)
    information = jacobian.T @ np.linalg.pinv(difference @ difference.T) @ jacobian
    return np.sqrt(np.diag(np.linalg.inv(information)))


def test_the_bounds_of_the_antenna_sets_stand_in_the_ratios_of_table_1():
    bounds = [_bounds_by_pseudo_inverse(DEFAULT_ANTENNAS[in_use(name)]) for name in SETS]
    ratios = np.array(bounds) / np.array(list(PRINTED_DEG.values()))
    # Rounding the places to 0.01 mm moves the smallest extent, of some millimetres, by half a per cent at most.
    np.testing.assert_allclose(ratios / ratios[0, 0], 1, rtol=0.01)


@pytest.mark.parametrize("name", SETS)
def test_the_closed_form_of_the_bounds_is_that_of_all_pairwise_differences(name):
    antennas = DEFAULT_ANTENNAS[in_use(name)]
    np.testing.assert_allclose(boresight_bounds(antennas, sigma_p=0.3), 0.3 * _bounds_by_pseudo_inverse(antennas))


def test_the_array_fills_its_box_with_antennas_half_a_wavelength_apart():
    assert np.all(np.abs(DEFAULT_ANTENNAS) <= [0.04, 0.02])
    assert np.abs(DEFAULT_ANTENNAS[:, 1]).max() == 0.02
    gaps = [np.linalg.norm(a - b) for a, b in itertools.combinations(DEFAULT_ANTENNAS, 2)]
    assert min(gaps) > SMALLEST_SPACING - 2e-5


def test_the_antenna_sets_are_small_and_large_where_the_paper_says():
    extent = {name: np.ptp(DEFAULT_ANTENNAS[in_use(name)], axis=0) for name in SETS}
    assert extent["3-7-8"][1] < extent[ALL][1] / 4
    assert extent["1-2-5"][0] < extent[ALL][0] / 4
    assert np.all(extent["2-3-6"] > 0.9 * extent[ALL])


def test_the_fit_finds_the_layout_that_is_stored():
    np.testing.assert_allclose(fitted_layout(), DEFAULT_ANTENNAS, rtol=0, atol=1e-12)
