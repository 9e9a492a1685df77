"""Every number of every tracker of the catalogue: found by its name, with the derivative that differences have."""

import fnmatch
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from sim.agv import simulate_agv
from sim.imu import simulate_uwb_imu
from sim.line import simulate_line
from sim.ranging import chamber, simulate_ranges
from sim.stations import simulate_phases, work_station
from tests.tuning.worlds import line_tracker, walks
from trackers.aoa.fusion import bearing_tracker
from trackers.catalogue import TRACKERS
from trackers.core.chunks import as_dtype
from trackers.core.recording import Recording, stack
from trackers.core.rig import Tag
from trackers.core.tunable import tunables
from trackers.mhk.tracker import mhk_tracker
from trackers.recordings.trajectories import cut
from trackers.uwb_imu.fusion import range_tracker
from tuning.objectives import NegativeLogLikelihood, RootMeanSquareError, Weighted
from tuning.parameters import component_names, flatten, select_parameters, with_parameters
from tuning.problem import Problem
from tuning.uncertainty import unidentifiable

STEP = 1e-5

WORLDS = {
    "direct": ("phases", 12),
    "cascade": ("phases", 12),
    "beam": ("phases", 12),
    "das": ("phases", 12),
    "line-grid": ("line", 60),
    "line-pf": ("line", 60),
    "uwb-imu": ("imu", 60),
    "uwb": ("ranges", 40),
    "multilateration": ("ranges", 10),
    "trilateration": ("level", 10),
    "trilateration-compensated": ("level", 10),
    "floor-pf": ("floor", 25),
    "fix-kf": ("agv", 25),
    "fix-singer": ("agv", 25),
    "imm": ("agv", 25),
    "fix-mirror": ("agv", 25),
    "moving-average": ("agv", 25),
    "median": ("agv", 25),
    "mhk": ("agv", 40),
    "mhk-stamped": ("agv", 40),
}
"""By tracker the world whose recordings it reads, and how many rows are enough."""

IDLE = {
    "line-grid": ("start.sigma_speed", "filter.output_map.sigma_line"),
    "fix-mirror": ("*.floor",),
    "mhk": ("*.reported_std_scale",),
    "mhk-stamped": ("*.reported_std_scale",),
}
"""What has no effect on likelihood and error, by tracker: the speed of a tag that begins at rest, how well a path is known
(a covariance alone), the floor that no tag is under, and what a device reports of fixes that become medians.
"""


@cache
def _folder(kind):
    if kind == "phases":
        return simulate_phases(work_station(), n=1, n_points=12).folder(kind)
    if kind == "line":
        # A path so short that the tag halts where it bends within the first rows.
        knots = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
        return simulate_line("halts", 1, knots=knots, rest_s=1.0).folder(kind)
    if kind == "floor":
        made = _folder("agv")
        return replace(made, rig=replace(made.rig, outline=np.array([[-99.0, -99.0], [99.0, -99.0], [0.0, 99.0]])))
    if kind == "agv":
        made = simulate_agv(1, rows=40).folder(kind)
        reported = {f"{axis}_std_m": pl.lit(0.05) for axis in "xyz"}
        return replace(made, tables=made.tables | {"fixes": made.tables["fixes"].with_columns(**reported)})
    if kind == "imu":
        # A gap in the IMU, for what stands in for it there.
        return simulate_uwb_imu(chamber(), n=1, n_points=60, gap_s=(0.1, 1.0)).folder(kind)
    made = simulate_ranges(chamber(), n=1, n_points=15).folder(kind)
    if kind == "level":
        return replace(made, rig=replace(made.rig, tags={"0": Tag(height=1.2, offset=None)}))
    return made


@cache
def _tracker(name):
    """The tracker as the command line builds it, and the first rows of its recording."""
    kind, rows = WORLDS[name]
    entry = TRACKERS[name]
    trajectory = next(iter(entry.trajectories(_folder(kind), False)))
    planar = entry.planar(trajectory, False)
    return entry.build(trajectory, planar), stack([cut(trajectory.recording, 0, rows)]), entry.bearing_only, planar


def test_the_catalogue_is_covered():
    assert set(TRACKERS) - set(WORLDS) == {"bearings"}, "its gradient is tested in tests/tuning/test_fit.py"


PROMISED = {
    "direct": "motion.sigma_a sensors.*.sigma_p sensors.*.offsets track_loss.nis_limit",
    "cascade": "beams.*.motion.sigma_a beams.*.sigma_p fusion.motion.sigma_a fusion.sensors.bearings.reported_std_scale",
    "beam": "motion.sigma_a sensors.*.sigma_p sensors.*.offsets",
    "line-grid": "motion.sigma_a motion.halting motion.rest sensors.fixes.sigma_p start.sigma_start",
    "line-pf": "motion.sigma_a motion.halting motion.rest sensors.fixes.sigma_p start.sigma_start",
    "uwb-imu": "motion.noise.sigma_accel motion.noise.sigma_gyro motion.noise.*_walk motion.gravity sensors.*.bias",
    "uwb": "motion.sigma_a motion.sigma_bias motion.time_constant sensors.ranges.sigma_r sensors.ranges.bias track_loss.nis_limit",
    "fix-kf": "motion.sigma_a sensors.fixes.sigma_horizontal sensors.fixes.dof sensors.fixes.latency track_loss.nis_limit",
    "fix-singer": "motion.sigma_a motion.tau sensors.fixes.latency",
    "imm": "motion.modes.*.sigma_a filter.switching_rate filter.mode_prior sensors.fixes.latency",
    "fix-mirror": "filter.switching_rate filter.mode_prior filter.reach sensors.fixes.offset sensors.fixes.shrink",
    "mhk": "fusion.*.p_still fusion.*.p_full fusion.*.a_still fusion.*.covariance median.speed_limit fusion.*.latency",
    "multilateration": "sigma_r",
    "trilateration-compensated": "sigma_r",
}
"""By tracker what a user may want tuned."""


@pytest.mark.parametrize("name", PROMISED)
def test_what_a_user_may_want_tuned_is_found_by_name(name):
    found = tunables(_tracker(name)[0])
    missing = [pattern for pattern in PROMISED[name].split() if not fnmatch.filter(found, pattern)]
    assert missing == []


def test_the_rates_at_which_modes_and_accelerations_change_are_found_by_name():
    assert "fusion.filter.rate" in tunables(mhk_tracker(rate=1.0))
    assert {"sensors.bearings.dof", "track_loss.nis_limit", "start.sigma_position"} <= set(tunables(bearing_tracker()))
    assert np.shape(tunables(range_tracker(8))["sensors.ranges.bias"].raw) == (8,)


UNTUNED = ("das", "moving-average", "median", "trilateration", "line-pf", "floor-pf")
"""Baselines without a number that makes a difference, and particles, whose derivative is none of differences."""


@pytest.mark.parametrize("name", ["das", "moving-average", "median"])
def test_what_has_no_number_but_a_window_has_nothing_to_tune(name):
    with pytest.raises(ValueError, match="matches no tunable"):
        select_parameters(_tracker(name)[0], "*window*")


def test_the_length_of_a_window_is_no_tunable():
    with pytest.raises(ValueError, match=r"matches no tunable; this tracker has: median\.speed_limit"):
        select_parameters(_tracker("mhk")[0], "median.window")


def test_a_number_without_effect_is_reported_as_that():
    tracker = line_tracker()
    parameters = select_parameters(tracker, ("motion.sigma_v", "sensors.gauge.sigma"))
    # rows at the same time do not depend on the speed at which the position changes
    still = [Recording(0 * r.times, r.readings, r.inputs, r.truth) for r in walks([30] * 4, 0)]
    problem = Problem(tracker, [stack(still)], NegativeLogLikelihood(), parameters)
    slopes = problem.evaluate(flatten(parameters)).term_gradients
    assert [n for n, idle in zip(component_names(parameters), unidentifiable(slopes), strict=True) if idle] == [
        "motion.sigma_v"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in WORLDS if name not in UNTUNED])
def test_the_derivative_by_every_tunable_is_the_central_difference(name):
    """Of the likelihood and of the error, both at once; particles have a derivative of their own, see `verify`."""
    tracker, batch, bearing_only, planar = _tracker(name)
    parameters = select_parameters(tracker, "*")
    vector = flatten(parameters)
    labels = np.array([p.label for p in parameters for _ in range(np.size(p.example.raw))])
    # A latency of zero is where a truth between rows has a corner, and a limit that is never reached has no effect.
    vector[np.char.endswith(labels, "latency")] += 0.264
    vector[labels == "median.speed_limit"] = np.log(0.3)
    error = RootMeanSquareError("direction" if bearing_only else "position", 2 if planar or bearing_only else 3)
    both = Weighted((NegativeLogLikelihood(), error), (1.0, 1.0))
    model = as_dtype(tracker, batch.dt.dtype)

    def figures(v):
        sums = [jnp.sum(x) for x in with_parameters(model, parameters, v).accumulate(batch, both.terms)]
        heard = sums[1] > 0  # a baseline has no likelihood
        return jnp.stack([jnp.where(heard, sums[0] / jnp.where(heard, sums[1], 1.0), 0.0), error.value(sums[2:])])

    slopes = np.asarray(jax.jit(jax.jacfwd(figures))(jnp.asarray(vector)))
    shifted = vector + STEP * np.concatenate([np.eye(len(vector)), -np.eye(len(vector))])
    up, down = np.split(np.asarray(jax.jit(lambda vs: jax.lax.map(figures, vs))(jnp.asarray(shifted))), 2)
    numeric = (up - down).T / (2 * STEP)
    assert np.all(np.isfinite(slopes))
    # step², and rounding of the figure / step
    atol = 1e-8 * np.maximum(1.0, np.abs(up).max(axis=0))[:, None]
    assert np.all(np.abs(slopes - numeric) <= 1e-5 * np.abs(numeric) + atol)
    idle = {label for label in set(labels) if not slopes[:, labels == label].any()}
    expected = IDLE.get(name, ())
    assert idle == {label for label in set(labels) if any(fnmatch.fnmatchcase(label, e) for e in expected)}
