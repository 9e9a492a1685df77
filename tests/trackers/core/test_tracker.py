"""Trajectories of a batch know nothing of each other, of padding, or of where they stand; curved states included."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import NEVER_LOST, KnownStart, recording
from trackers.core.algebra import Vector
from trackers.core.estimates import Status
from trackers.core.motion import AbstractMotion, ConstantVelocity, Kinematic, Noise
from trackers.core.particle.filter import ParticleFilter
from trackers.core.recording import Recording, stack
from trackers.core.sensor import AbstractSensor, Channel, independent
from trackers.core.state import Heading, Rotation, wrap
from trackers.core.tracker import Tracker
from trackers.core.tunable import Scale


class Pose(NamedTuple):
    attitude: Rotation
    course: Heading


class Turning(AbstractMotion):
    """A body that turns, and a course that wanders with it."""

    sigma: Noise

    @property
    def noise_dimension(self):
        return 3

    def step(self, state, inputs, dt, w):
        kick = self.sigma.value * jnp.sqrt(dt)
        attitude = state.attitude.retract([kick * w[0] + 0.3 * dt, kick * w[1], kick * w[2] - 0.1 * dt])
        return Pose(attitude, state.course.retract([kick * (w[0] + w[1]) - 0.8 * dt]))

    def view(self, state):
        return state


class Compass(AbstractSensor):
    """Two components of the body's axis x in the world, or the course: curved states seen through plain numbers."""

    sigma: Noise
    course: bool = eqx.field(static=True)

    @property
    def channels(self):
        return (Channel("course", "rad", True),) if self.course else tuple(Channel(a, "1") for a in "xy")

    def measure(self, view, inputs):
        return [view.course.angle] if self.course else list(view.attitude.apply(Vector(1.0, 0.0, 0.0)))[:2]

    def residual(self, reading, predicted):
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        differences = [wrap(d) for d in differences] if self.course else differences
        return independent(differences, [self.sigma.value] * len(differences), reading.seen)


class Ruler(AbstractSensor):
    """A linear sensor: the position, or the velocity."""

    sigma: Noise
    field: str = eqx.field(static=True)

    @property
    def channels(self):
        return (Channel(self.field, "m"),)

    def measure(self, view, inputs):
        return list(getattr(view, self.field))

    def residual(self, reading, predicted):
        return independent([reading.values[0] - predicted[0]], [self.sigma.value], reading.seen)


def _kinematic(x):
    return Kinematic(Vector(x[0]), Vector(x[1]))


def _pose(x):
    return Pose(Rotation.exp(x[:3]), Heading(x[3]))


def _flat(sigma=0.7):
    sensors = {"a": Ruler(Scale(0.3), "position"), "b": Ruler(Scale(0.5), "velocity")}
    return Tracker(ConstantVelocity(sigma, 1), sensors, KnownStart(_kinematic), track_loss=NEVER_LOST)


def _curved(sigma=0.2):
    sensors = {"a": Compass(Scale(0.1), False), "b": Compass(Scale(0.2, "rad"), True)}
    return Tracker(Turning(Scale(sigma)), sensors, KnownStart(_pose), track_loss=NEVER_LOST)


def _particles(sigma=0.7):
    return eqx.tree_at(lambda t: t.filter, _flat(sigma), ParticleFilter(50))


TRACKERS = {"flat": (_flat, 2, 1), "curved": (_curved, 4, 2), "particles": (_particles, 2, 1)}
LANES, ROWS = 6, 14


def _recordings(n, m, seed=0):
    """Ragged recordings with masks and irregular times, with rows at one time."""
    rng, recordings = np.random.default_rng(seed), []
    for trajectory in range(LANES):
        rows = ROWS - 2 * trajectory
        times = 5.0 + np.cumsum(rng.exponential(0.3, rows) * (rng.random(rows) > 0.3))
        readings = {name: (rng.normal(size=(rows, k)), rng.random((rows, k)) > 0.3) for name, k in (("a", m), ("b", 1))}
        recordings.append(recording(times, readings, rng.normal(size=n) * 0.5, np.diag(rng.uniform(0.1, 1.0, n))))
    return recordings


class Case:
    def __init__(self, name):
        self.make, *self.sizes = TRACKERS[name]
        self.recordings = _recordings(*self.sizes)
        self.estimates = self.make().run(stack(self.recordings))


@pytest.fixture(scope="module", params=TRACKERS)
def case(request):
    return Case(request.param)


def _assert_same_bits(mine, other, rows=slice(None)):
    for a, b in zip(*(jax.tree_util.tree_leaves(_as_tree(e)) for e in (mine, other)), strict=True):
        np.testing.assert_array_equal(a[..., rows], b[..., rows])


def _as_tree(e):
    return e.mean, e.cov_upper, e.log_likelihood, e.nis, e.nis_dof, e.wrapped, e.status


def test_a_padded_recording_equals_the_unpadded_one_to_the_bit(case):
    padded = case.make().run(stack(case.recordings, rows=ROWS + 3))
    for trajectory, one in enumerate(case.recordings):
        rows = len(one)
        _assert_same_bits(padded[trajectory], case.estimates[trajectory], slice(rows))
        assert np.all(padded[trajectory].status[rows:] == Status.PADDING)
        for leaf in jax.tree_util.tree_leaves((padded[trajectory].mean, padded[trajectory].cov_upper)):
            np.testing.assert_array_equal(
                leaf[..., rows:], np.repeat(leaf[..., rows - 1 : rows], ROWS + 3 - rows, axis=-1)
            )


def test_what_stands_in_a_padding_row_is_never_looked_at(case):
    batch = stack(case.recordings)
    hidden = ~batch.valid

    def fill(x):
        return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), np.asarray(1e30, x.dtype), x)

    dirty = batch._replace(dt=fill(batch.dt), readings=jax.tree_util.tree_map(fill, batch.readings))
    _assert_same_bits(case.make().run(dirty), case.estimates)


@pytest.mark.parametrize("garbage", [1e30, -1e30, None])
def test_one_trajectory_of_garbage_changes_no_other_by_a_bit(case, garbage):
    batch = stack(case.recordings)
    rng = np.random.default_rng(1)

    def spoil(reading):
        values, seen = reading.values.copy(), reading.seen.copy()
        values[..., 2] = rng.normal(size=values.shape[:-1]) * 1e3 if garbage is None else garbage
        seen[..., 2] = True
        return reading._replace(values=values, seen=seen)

    spoilt = batch._replace(readings={name: spoil(r) for name, r in batch.readings.items()})
    estimates = case.make().run(spoilt)
    for trajectory in (0, 1, 3, 4, 5):
        _assert_same_bits(estimates[trajectory], case.estimates[trajectory])
    assert not np.array_equal(estimates[2].nis, case.estimates[2].nis)


def test_a_trajectory_is_the_same_wherever_it_stands_in_the_batch(case):
    order = [3, 5, 0, 4, 1, 2]
    shuffled = case.make().run(stack([case.recordings[k] for k in order]))
    for column, trajectory in enumerate(order):
        _assert_same_bits(shuffled[column], case.estimates[trajectory], slice(len(case.recordings[trajectory])))


def test_a_trajectory_of_a_batch_is_the_one_run_alone():
    recordings = _recordings(2, 1)
    alone, together = _flat().run(recordings[0]), _flat().run(stack(recordings))[0]
    for a, b in zip(*map(jax.tree_util.tree_leaves, (_as_tree(alone), _as_tree(together))), strict=True):
        # Another shape is another program, which may round otherwise: 1e-12 is a few thousand roundings.
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_chunks_side_by_side_give_what_one_chunk_gives():
    batch = stack(_recordings(2, 1))
    in_pairs, together = _flat().run(batch, chunk=2), _flat().run(batch)
    for a, b in zip(*map(jax.tree_util.tree_leaves, (_as_tree(in_pairs), _as_tree(together))), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_a_second_call_with_other_numbers_compiles_nothing(case):
    n, m = case.sizes
    compiled = []
    other = case.make(0.55), stack(_recordings(n, m, seed=9))

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x + 41.5)(1.0)
        assert compiled, "the listener hears no compilation at all"
        compiled.clear()
        estimates = other[0].run(other[1])
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled
    assert not np.array_equal(estimates.cov_upper, case.estimates.cov_upper)


def test_two_readings_in_a_row_are_two_rows_at_one_time_for_linear_sensors():
    both = _recordings(2, 1)[0]
    twice = {k: np.repeat(v, 2, axis=0) for k, v in both.inputs.items()}
    readings = {}
    for name, rows in (("a", 0), ("b", 1)):
        r = both.readings[name]
        seen = np.repeat(r.seen, 2, axis=0)
        seen[1 - rows :: 2] = False
        # The row that starts a track is not read: both of its readings stand in the first of the two.
        seen[:2] = False
        readings[name] = (np.repeat(r.values, 2, axis=0), seen)
    split = Recording(np.repeat(both.times, 2), {}, twice)
    split = recording(split.times, readings, both.inputs["start_mean"][0], np.diag(both.inputs["start_cov"][0][[0, 2]]))
    estimates = _flat().run(stack([both, split]))
    one, two = estimates[0], estimates[1]
    for a, b in zip(
        *map(jax.tree_util.tree_leaves, ((one.mean, one.cov_upper), (two.mean, two.cov_upper))), strict=True
    ):
        np.testing.assert_allclose(a[..., :ROWS], b[..., 1 : 2 * ROWS : 2], rtol=1e-12, atol=1e-13)
    pairs = two.log_likelihood[: 2 * ROWS].reshape(ROWS, 2).sum(axis=1)
    np.testing.assert_allclose(one.log_likelihood[:ROWS], pairs, rtol=1e-12, atol=1e-12)
