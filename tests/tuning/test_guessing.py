"""Noise levels found in recordings made by the models themselves, from starts that are wrong by orders of magnitude."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST
from tests.tuning.worlds import STATION, LineStart, beams, line_tracker, walks
from trackwright.sim.corruptions import white_noise
from trackwright.sim.ranging import chamber, simulate_ranges
from trackwright.trackers.aoa.beam import beam_tracker
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import AbstractMotion, Placed
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent
from trackwright.trackers.core.model.tunable import Scale, tunables
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.fixes import FloorFixes
from trackwright.trackers.line.motion import LineMotion, PathState
from trackwright.trackers.line.tracker import line_grid_tracker
from trackwright.trackers.mhk.tracker import mhk_tracker
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.recordings.tracks import batches as in_batches
from trackwright.trackers.uwb_imu.fusion import range_tracker
from trackwright.tuning.guessing import (
    first_guess,
    noise_levels,
)
from trackwright.tuning.optimisation import coarse_grid
from trackwright.tuning.parameters import select_parameters

FAR = [(10.0, 10.0), (0.1, 0.1), (10.0, 0.1), (0.1, 10.0)]
LEVELS = {"motion.sigma_a": 0.7, "motion.sigma_z": 0.1, "sensors.fixes.sigma_horizontal": 0.15}
LEVELS["sensors.fixes.sigma_vertical"] = 0.4


def _values(tracker):
    return {k: np.asarray(v.value) for k, v in tunables(tracker).items()}


def _assert_found(tracker, levels, within=3.0):
    found = _values(tracker)
    for name, level in levels.items():
        assert level / within < found[name] < level * within, f"{name}: {found[name]}, made with {level}"


def _fixes(seed, count=8, rows=300, missing=0.0, uneven=0.0, dof=None):
    """Fixes of tags that move as `GroundMotion` does, with white noise or Student's t."""
    rng = np.random.default_rng(seed)
    recordings = []
    for k in range(count):
        dts = 0.1 * np.exp(uneven * rng.normal(size=rows))
        speed = np.cumsum(0.7 * np.sqrt(dts)[:, None] * rng.normal(size=(rows, 2)), axis=0)
        height = 1 + np.cumsum(0.1 * np.sqrt(dts) * rng.normal(size=rows))
        noise = rng.normal(size=(rows, 3)) if dof is None else rng.standard_t(dof, (rows, 3))
        values = np.column_stack([np.cumsum(speed * dts[:, None], axis=0), height]) + [0.15, 0.15, 0.4] * noise
        seen = np.repeat(rng.random((rows, 1)) >= missing, 3, axis=1)
        readings = {FIXES: Readings(np.where(seen, values, 0.0), seen, np.zeros((rows, 3)))}
        recordings.append(Recording(np.cumsum(dts), readings, {"height": np.zeros(rows)}, {}, str(k)))
    return recordings


@pytest.mark.parametrize("factors", [(10, 0.1, 10, 0.1), (0.1, 10, 0.1, 10)])
def test_every_level_of_fixes_is_found_from_starts_wrong_in_all_ways(factors):
    start = fix_tracker(*(k * v for k, v in zip(factors, LEVELS.values(), strict=True)), dof=None)
    _assert_found(first_guess(start, stack(_fixes(2))), LEVELS, 1.5)


@pytest.mark.parametrize("wrong", FAR)
def test_a_random_walk_and_its_gauge_are_found_by_the_likelihood(wrong):
    guess = first_guess(line_tracker(0.3 * wrong[0], 0.2 * wrong[1]), stack(walks([200] * 8, 1)))
    _assert_found(guess, {"motion.sigma_v": 0.3, "sensors.gauge.sigma": 0.2}, 1.5)


class Drift(AbstractMotion):
    """A random walk on a line with a level of an unusual name, and a number named like a level that is none."""

    liveliness: Any
    sigma_bias_walk: Any

    @property
    def noise_dimension(self):
        return 1

    def step(self, state, inputs, dt, w):
        return Placed(state.position + w * (self.liveliness.value * self.sigma_bias_walk.value * jnp.sqrt(dt)))


class Dial(AbstractSensor):
    """Reads a place on a line with white noise of an unusual name."""

    fuzziness: Any
    sigma_bias_walk: Any

    @property
    def channels(self):
        return (Channel("x", "m"),)

    def measure(self, view, inputs):
        return [view.position[0]]

    def residual(self, reading, predicted):
        return independent(
            [reading.values[0] - predicted[0]], [self.fuzziness.value * self.sigma_bias_walk.value], reading.seen
        )


def test_levels_of_a_users_own_motion_and_sensor_are_found_by_their_roles_whatever_their_names():
    motion = Drift(Scale(3.0, "m/sqrt(s)", "process noise"), Scale(1.0))
    sensor = Dial(Scale(0.02, "m", "measurement noise"), Scale(1.0))
    tracker = Tracker(motion, {"gauge": sensor}, LineStart(), track_loss=NEVER_LOST)
    assert [p.label for p in noise_levels(tracker)] == ["motion.liveliness", "sensors.gauge.fuzziness"]
    guess = first_guess(tracker, stack(walks([200] * 8, 1)))
    _assert_found(guess, {"motion.liveliness": 0.3, "sensors.gauge.fuzziness": 0.2}, 1.5)
    assert _values(guess)["sensors.gauge.sigma_bias_walk"] == 1.0
    grid = coarse_grid(select_parameters(tracker, ("motion.liveliness", "sensors.gauge.fuzziness")), np.zeros(2))
    assert sorted({tuple(np.sign(v)) for v in grid}) == [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]


def test_what_changes_nothing_and_what_is_frozen_stays():
    world, start = stack(walks([200] * 8, 1)), line_tracker(3.0, 2.0)
    before = _values(start)
    kept = _values(first_guess(start, world, frozen=("sensors.*",)))
    changed = {k for k in before if not np.array_equal(before[k], kept[k])}
    assert changed == {"motion.sigma_v"}
    planar = fix_tracker(0.7, 5.0, 0.15, 7.0, dof=None, planar=True)
    level = [
        Recording(r.times, {FIXES: Readings(r.readings[FIXES].values, r.readings[FIXES].seen & [True, True, False])},
                  r.inputs, {}, r.name)
        for r in _fixes(3)
    ]  # fmt: skip
    found = _values(first_guess(planar, stack(level)))
    assert found["motion.sigma_z"] == pytest.approx(5.0)
    assert found["sensors.fixes.sigma_vertical"] == pytest.approx(7.0)


def test_the_level_of_biases_alone_is_guessed_too():
    world = simulate_ranges(chamber(), n=4, n_points=80, seed=2, corruptions={"white": white_noise(0.1)})
    trajectories = list(TRACKERS["uwb"].trajectories(world.folder("ranges"), False))
    start = range_tracker(8, sigma_bias=5.0)
    found = _values(
        first_guess(start, [b for _, b in in_batches(trajectories)], ("*sigma_[arz]", "*shared", "start.*"))
    )
    changed = {name for name, value in _values(start).items() if not np.array_equal(value, found[name])}
    assert changed == {"motion.sigma_bias"}
    assert found["motion.sigma_bias"] < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("wrong", FAR)
def test_system_a_beams(wrong):
    start = beam_tracker(STATION, "1", 0.15 * wrong[0], 0.2 * wrong[1])
    guess = first_guess(start, stack(beams(16, 200, 0.15, 0.2, seed=0, missing=0.25)))
    _assert_found(guess, {"motion.sigma_a": 0.15, "sensors.1.sigma_p": 0.2})


def _on_a_line(line, sigma_a, sigma_p):
    rng, motion, recordings = np.random.default_rng(0), LineMotion(line, sigma_a), []
    for k in range(8):
        state, path = PathState(np.array(0.0), np.array(0.3)), []
        for w in rng.normal(size=300):
            state = motion.step(state, None, np.array(0.2), Vector(w))
            path.append([float(x) for x in line.position(state.arclength)])
        values = np.array(path) + sigma_p * rng.normal(size=(300, 2))
        recordings.append(
            Recording(0.2 * np.arange(300), {FIXES: Readings(values, np.ones((300, 2), bool))}, name=str(k))
        )
    return stack(recordings)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", FAR)
def test_system_b_on_a_grid(wrong):
    line = Polyline(np.array([[0.0, 0.0], [30.0, 0.0], [30.0, 12.0]]))
    motion, sensor = LineMotion(line, 0.05 * wrong[0]), FloorFixes(0.3 * wrong[1])
    start = line_grid_tracker(motion, {FIXES: sensor}, spacing=0.2, speeds=32)
    guess = first_guess(start, _on_a_line(line, 0.05, 0.3))
    _assert_found(guess, {"motion.sigma_a": 0.05, "sensors.fixes.sigma_p": 0.3})


@pytest.mark.slow
@pytest.mark.parametrize("wrong", FAR)
def test_system_c_ranges(wrong):
    world = simulate_ranges(chamber(), n=8, n_points=200, corruptions={"white": white_noise(0.1)})
    trajectories = list(TRACKERS["uwb"].trajectories(world.folder("ranges"), False))
    # the walk is none of the motion's: only the sensor's level is known
    start = range_tracker(
        8, sigma_a=0.3 * wrong[0], sigma_z=0.7 * wrong[0], sigma_r=0.1 * wrong[1], positive_skew=1.001
    )
    _assert_found(first_guess(start, [b for _, b in in_batches(trajectories)]), {"sensors.ranges.sigma_r": 0.1})


@pytest.mark.slow
@pytest.mark.parametrize("wrong", FAR)
def test_system_d_fusion(wrong):
    covariance = 0.15**2 * np.eye(3)
    start = mhk_tracker(covariance * wrong[1] ** 2, 0.7 * wrong[0], window=1, speed_limit=1e3)
    guess = first_guess(start, stack(_fixes(4)))
    # the paper's acceleration takes part of what white noise would explain, and its noise is one for all axes
    found = _values(guess)
    assert 0.7 / 3 < found["fusion.motion.sigma_a"] < 0.7 * 3
    spread = np.sqrt(np.diagonal(found["fusion.sensors.fixes.covariance"]))
    assert np.all((spread > 0.15 / 3) & (spread < 0.4 * 3))
