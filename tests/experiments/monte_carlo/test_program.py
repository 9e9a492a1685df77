"""The program of a chunk beside the same trajectories by way of recordings, and worlds drawn in a program."""

import re
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

import trackwright as tw
from trackwright.experiments.monte_carlo import chunk
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig, World
from trackwright.experiments.monte_carlo.program import UnfitError, compiled, part_of
from trackwright.sim.keys import keys_of, trajectory_keys
from trackwright.sim.worlds import WORLDS
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.chunks import as_dtype

N, SLOW = 6, pytest.mark.slow
RECORDED = "sum (along|way|energy|log density|slow|n nis|n_no|n_hole|no |zero|losses|lost s|span s)"  # not in programs
LINE, STATION = {"rate_hz": 1.0}, {"rows": 30, "drop_outs": 0.2, "outliers": 0.05, "gauss_markov": 0.1}
AGV, FEW = {"rows": 60, "mirror": 0.1, "latency": 0.2}, {"rows": 3, "drop_outs": 0.95}
PAIRS = [("line", "fix-kf", {**LINE, "situation": "speeds"}), ("station", "das", FEW)]
LONG = [("line", "fix-kf", LINE), ("station", "beam", STATION), ("agv", "median", AGV),
        ("station", "direct", {**STATION, "lost_station": "2", "masked_antenna": ("1", 3)}),
        ("station", "cascade", STATION), ("agv", "imm", AGV), ("agv", "mhk", AGV),
        ("ranges", "uwb", {"rows": 60, "lost": 0.5}), ("fusion", "bearings", {"rows": 60, "lost": 0.3})]  # fmt: skip


def _study(world, tracker, numbers, **config):
    worlds, trackers = {world: World(WORLDS[world], numbers)}, {tracker: TrackerConfig(tracker, **config)}
    return Study("study", "", worlds, trackers, runs=2 * N, metrics=("rmse_m",))


def _both(study):
    condition, name, ids = study.conditions[0], next(iter(study.trackers)), np.arange(N)
    program = chunk._program_of(study, condition, name)
    assert program is not None
    batches = partial(chunk._batches, study, condition, name, chunk._folder(study, condition, ids))
    return program.run(part_of(study.seed, ids)), chunk._scored(study, study.trackers[name], batches, ids)


@pytest.mark.parametrize(("world", "tracker", "numbers"), [*PAIRS, *(pytest.param(*one, marks=SLOW) for one in LONG)])
def test_the_program_sums_what_recordings_give(world, tracker, numbers, **config):
    ours, expected = _both(_study(world, tracker, numbers, **config))
    more = {name for name in expected.keys() - ours.keys() if expected[name].any() and not re.match(RECORDED, name)}
    assert not (ours.keys() - expected.keys()) | more
    for name in (name for name in ours if not name.startswith(("cells", "counts"))):
        np.testing.assert_allclose(ours[name], expected[name], rtol=1e-5, atol=1e-5, err_msg=name)
    for name in (name for name in ours if name.startswith("counts")):
        assert ours[name].sum() == expected[name].sum()


@pytest.mark.parametrize("config", [{"smooth": True}, pytest.param({"every": 0.3}, marks=SLOW)])
def test_a_smoothed_or_thinned_tracker_has_a_program_too_where_readings_are_lost(config):
    test_the_program_sums_what_recordings_give("fusion", "bearings", {"rows": 12, "lost": 0.4}, **config)


@pytest.mark.parametrize(
    ("world", "tracker", "reason"),
    [("ranges", "multilateration", "other numbers than its own"), ("line", "line-pf", "particles or cells"),
     ("tool", "uwb-imu", "no draw"), ("body", "body", "no draw")],
)  # fmt: skip
def test_a_tracker_whose_rows_are_no_drawn_numbers_is_told_apart(world, tracker, reason):
    study = _study(world, tracker, {})
    folder = WORLDS[world](np.zeros(1, int), 0)
    with pytest.raises(UnfitError, match=reason):
        compiled(folder, lambda f: study.trackers[tracker].spec.batches([f], tracker), None, part_of(0, np.arange(N)))
    assert chunk._program_of(study, study.conditions[0], tracker) is None


def test_a_folder_that_is_not_as_it_was_drawn_has_no_program():
    def moved(ids, seed):
        world = tw.simulate.station(ids=ids, seed=seed, rows=5)
        return replace(world, given={**world.arrays, "positions": world.positions + 0.1}).folder()

    def calibrated(ids, seed):
        return replace(tw.simulate.station(ids=ids, seed=seed, rows=5).folder(), calibration=tw.Calibration())

    for make in (moved, calibrated):
        study = Study("study", "", {"w": World(make)}, {"beam": TrackerConfig("beam")}, runs=2 * N, metrics=("rmse_m",))
        assert chunk._program_of(study, study.conditions[0], "beam") is None


@pytest.mark.parametrize(
    ("world", "numbers"), [*{w: (w, n) for w, _, n in PAIRS}.values(), ("ranges", {}), ("fusion", {})]
)
def test_a_world_drawn_in_a_program_is_the_one_in_its_folder(world, numbers):
    draw = getattr(tw.simulate, world)(n=1, **numbers).folder().tables.draw
    part = part_of(5, np.arange(3))
    inside = jax.jit(lambda key, ids: as_dtype(draw, float)(keys_of(key, ids)))(*part)
    for name, expected in draw(trajectory_keys(5, [0, 1, 2])).items():
        np.testing.assert_allclose(inside[name], expected, atol=2e-6, err_msg=name)


def test_conditions_that_differ_in_numbers_share_a_program():
    worlds = {"station": World(WORLDS["station"], {"rows": 20})}
    grid = {"world.sigma_p, sensors.*.sigma_p": [0.1, 0.2]}
    study = Study("study", "", worlds, {"beam": TrackerConfig("beam")}, runs=2 * N, grid=grid)
    first, second = (chunk._program_of(study, condition, "beam") for condition in study.conditions)
    assert first.program is second.program
    errors = [one.run(part_of(0, np.arange(N)))["sum squares direction_rad"].sum() for one in (first, second)]
    assert errors[0] < errors[1]


GRADIENTS = [
    pytest.param("line", "fix-kf", "rmse_m", "motion.sigma_a", 1e-4, marks=SLOW),
    pytest.param("agv", "imm", "rmse_3d_m", "sensors.fixes.sigma*", 1e-4, marks=SLOW),
    pytest.param("ranges", "uwb", "rmse_3d_m", "sensors.ranges.sigma_r", 1e-6, marks=SLOW),
    # Also of the world's noise; the place where a search begins a track has no derivative.
    pytest.param("station", "beam", "rmse_direction_rad", "sensors.*.sigma_p", 2e-3, marks=SLOW),
    pytest.param("station", "direct", "mean_3d_m", "sensors.*.sigma_p", 2e-3, marks=SLOW),
]


@pytest.mark.parametrize(("world", "tracker", "metric", "tunables", "tolerance"), GRADIENTS)
def test_the_gradient_of_an_expected_error_is_its_difference_quotient(world, tracker, metric, tunables, tolerance):
    rows = {"line": {"rate_hz": 1.0}}.get(world, {"rows": 40})

    def error(number):
        made = getattr(tw.simulate, world)(n=4, seed=3, **rows, **({"sigma_p": number} if world == "station" else {}))
        return tw.expected(made, tracker, metric, {tunables: number})

    value, slope = jax.jit(jax.value_and_grad(error))(0.3)
    below, at, above = (float(error(0.3 + step)) for step in (-1e-5, 0.0, 1e-5))
    assert value == pytest.approx(at, rel=1e-9)
    assert slope == pytest.approx((above - below) / 2e-5, rel=tolerance)


@pytest.mark.slow
def test_the_gradient_by_the_places_of_anchors_is_their_difference_quotient():
    world = tw.simulate.ranges(n=4, seed=3, rows=40)
    places, step = np.stack([world.draw.rig.anchors[name] for name in sorted(world.draw.rig.anchors)]), 1e-5
    error = jax.jit(lambda anchors: tw.expected(world, "uwb", "rmse_3d_m", anchors=anchors))
    slopes = np.asarray(jax.jit(jax.grad(error))(places))
    assert float(error(places)) == pytest.approx(float(tw.expected(world, "uwb", "rmse_3d_m")), rel=1e-9)
    for entry in ((0, 0), (1, 2), (3, 1)):
        by = step * (np.arange(12) == np.ravel_multi_index(entry, (4, 3))).reshape(4, 3)
        assert slopes[entry] == pytest.approx(float(error(places + by) - error(places - by)) / (2 * step), rel=1e-5)
    with pytest.raises(UnusableInput, match=r"anchors have shape \(2, 3\); expected \(4, 3\), m"):
        error(places[:2])


@pytest.mark.slow
def test_an_expected_error_that_has_no_program_is_refused():
    with pytest.raises(UnusableInput, match="the world has no draw for programs; run a study"):
        tw.expected(tw.simulate.tdoa(n=2), "tdoa")
    with pytest.raises(UnusableInput, match="rmse_KIND or mean_KIND"):
        tw.expected(tw.simulate.line(n=2, rate_hz=1.0), "fix-kf", "median_m")
