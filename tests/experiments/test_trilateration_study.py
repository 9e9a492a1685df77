"""The study of the paper's confidence compensation, with a handful of tags."""

import pytest

from experiments.trilateration_study import WORLDS, figures, world


@pytest.fixture(scope="module")
def clear():
    """Ten tags in line of sight."""
    return world(WORLDS["line of sight"], 10, 100)


def test_lengthening_every_range_makes_trilateration_worse_in_line_of_sight(clear):
    # 1.96 · 0.1 m / √3 = 11 cm on each of three ranges, where the noise is 3 cm.
    assert figures(clear, "trilateration-compensated")[0] > 1.5 * figures(clear, "trilateration")[0]


def test_all_four_ranges_are_better_than_three(clear):
    assert figures(clear, "multilateration")[0] < figures(clear, "trilateration")[0]
