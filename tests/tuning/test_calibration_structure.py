"""Errors that a line leaves: random ones that last are no structure, a step in the distance is."""

import numpy as np
import pytest

from tests.tuning.calibration_worlds import lasting, walk
from trackwright.tuning.calibration_structure import differs_by_distance


def _errors(seed):
    """Distances, errors that last and pieces of 5 s of a walk of 4 min."""
    rng = np.random.default_rng(seed)
    times, positions = walk(rng, 240.0)
    distance = np.linalg.norm(positions[:, :2], axis=1)
    errors = lasting(rng, times, positions, 0.05) + 0.05 * rng.normal(size=len(times))
    errors[::60] += 2.0  # reflections
    return distance, errors, (times // 5).astype(int)


def _left_by_a_line(distance, errors):
    return errors - np.polyval(np.polyfit(distance, errors, 1), distance)


def test_errors_about_a_line_are_seldom_called_structure():
    found = 0
    for seed in range(40):
        distance, errors, piece = _errors(seed)
        found += differs_by_distance(distance, _left_by_a_line(distance, errors + 0.02 * distance), piece, 0.07)
    assert found <= 1


@pytest.mark.parametrize("seed", range(5))
def test_a_step_contradicts_a_line(seed):
    distance, errors, piece = _errors(seed)
    left = _left_by_a_line(distance, errors + 0.35 * (distance > 6))
    assert differs_by_distance(distance, left, piece, 0.07)
    # The same structure, but too small to matter beside errors of a metre.
    assert not differs_by_distance(distance, left, piece, 1.0)


def test_too_few_pieces_decide_nothing():
    distance = np.linspace(1.0, 9.0, 100)
    errors = np.where(distance > 5, 0.3, 0.0)
    assert not differs_by_distance(distance, errors, np.zeros(100, int), 0.1)
    assert not differs_by_distance(distance, np.full(100, np.nan), np.arange(100) // 5, 0.1)
