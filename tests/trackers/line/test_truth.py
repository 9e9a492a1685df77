"""Ground truth along a known path, fitted to the fixes of a recording."""

import numpy as np
import pytest

from trackwright.sim.corruptions import white_noise
from trackwright.sim.line import THESIS_KNOTS, LineDraw
from trackwright.trackers.line.rows import fit_path_truth
from trackwright.trackers.line.truth import knot_times


@pytest.mark.parametrize("situation", ["constant", pytest.param("halts", marks=pytest.mark.slow), "speeds"])
def test_without_errors_the_knot_times_are_found(situation):
    world = LineDraw(situation, errors={}).drawn(seed=5)
    fitted = knot_times(THESIS_KNOTS, world.times, world.fixes[0])
    # Times are found by steps that shrink by 0.7 each: what is left is below a millimetre of travel.
    assert fitted.rms < 1e-3
    assert fitted.departed[0] == pytest.approx(10.0, abs=0.02)
    rests = fitted.departed[1:] - fitted.arrived[:-1]
    np.testing.assert_allclose(rests, 5.0 if situation == "halts" else 0.0, atol=0.05)
    np.testing.assert_allclose(fitted.positions(world.times), world.positions[0], atol=5e-3)


@pytest.mark.parametrize("situation", ["constant", "halts", "speeds"])
def test_with_the_errors_of_the_thesis_the_truth_is_within_two_decimetres(situation):
    world = LineDraw(situation).drawn(seed=6)
    fitted = knot_times(THESIS_KNOTS, world.times, world.fixes[0])
    error = fitted.positions(world.times) - world.positions[0]
    # A slow error of 0.22 m that lasts 1.5 s leaves 0.22·√(2·1.5/7) = 0.14 m after 7 s, half a segment, which
    # determines the time of one of its ends.
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.2


def test_no_other_knot_times_have_a_smaller_sum_of_squares():
    world = LineDraw("halts", {"white": white_noise(0.3)}).drawn(seed=7)
    times, fixes = world.times, world.fixes[0]
    fitted = knot_times(THESIS_KNOTS, times, fixes)
    rng, events = np.random.default_rng(0), np.stack([fitted.departed, fitted.arrived], axis=1).ravel()
    true = np.sqrt(np.mean(np.sum((fixes - world.positions[0]) ** 2, axis=1)))
    assert fitted.rms < true
    for scale in (0.01, 0.1, 1.0, 5.0):
        for _ in range(50):
            other = np.sort(events + scale * rng.normal(size=len(events)))
            positions = type(fitted)(fitted.knots, other[0::2], other[1::2], 0.0).positions(times)
            assert np.sqrt(np.mean(np.sum((fixes - positions) ** 2, axis=1))) > fitted.rms - 1e-4


def test_a_recording_gets_a_truth_along_its_path():
    world = LineDraw("halts").drawn(2, seed=8).folder("line")
    fitted, _ = fit_path_truth(world)
    assert fitted.tables["fixes"].equals(world.tables["fixes"])
    both = fitted.tables["truth"].join(world.tables["truth"], on=["t_s", "tag"], suffix="_true")
    apart = np.hypot(*(both[f"{a}_m"].to_numpy() - both[f"{a}_m_true"].to_numpy() for a in "xy"))
    assert np.sqrt(np.mean(apart**2)) < 0.2
    assert both["z_m"].unique().to_list() == [0.78]
