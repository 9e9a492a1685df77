"""Errors beside the Cramér–Rao bound in worlds of a tracker's own model, which no tracker of that model can beat."""

import pytest

from trackwright.experiments.lab.validation.error_over_bound import figures

SLOW = [("fusion", 0.5), ("fusion", 1.0), ("fusion", 2.0), ("body with odometry", 0.5), ("body with odometry", 2.0)]


@pytest.mark.parametrize(
    ("name", "noise"), [("body with odometry", 1.0), *(pytest.param(*x, marks=pytest.mark.slow) for x in SLOW)]
)
def test_errors_reach_the_bound_and_ellipses_hold(name, noise):
    found = figures(name, noise)
    assert 0.9 < found["position"] < 1.25
    assert 0.9 < found.get("heading", 1.0) < 1.25
    assert 0.8 < found["nees"] < 1.3
    assert 0.90 < found["inside"] < 0.98
