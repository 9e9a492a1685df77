"""The sensors of ranges and fixes: density, geometry from the inputs of a row, reported noise, and outliers among good ranges."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.known_start import Still
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector, diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.motion import Placed
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import Heading, Rotation
from trackwright.trackers.core.model.tunable import Real, Scale, freeze, replaced
from trackwright.trackers.parts.fixes import FixSensor
from trackwright.trackers.parts.ranges import RangeSensor, in_world_axes

ANCHORS = np.array([[5.0, 0.0, 2.0], [0.0, 6.0, 1.0], [-4.0, -3.0, 2.5], [1.0, -6.0, 2.2], [-5.0, 4.0, 0.5]])
BIASES = np.array([0.1, -0.05, 0.3, 0.02, 0.2])
POSITION = np.array([0.4, -0.3, 1.1])


def _inputs(slots):
    return {"anchors": jnp.asarray(ANCHORS[:slots].ravel()), "anchor": jnp.arange(slots, dtype=float)}


def _sensor(slots, positive_skew=2.0):
    sensor = RangeSensor(slots, 5, 0.1, positive_skew, 4.0)
    return replaced(sensor, {"bias": Real(BIASES, "m", 0.1)})


def test_a_planar_position_is_completed_by_the_known_height():
    sensor, inputs = freeze(_sensor(2)), _inputs(2)
    flat = sensor.measure(Placed(Vector(*POSITION[:2])), {**inputs, "height": POSITION[2]})
    expected = np.linalg.norm(POSITION - ANCHORS[:2], axis=1) + BIASES[:2]
    # Rounding of a square root.
    np.testing.assert_allclose(np.array(flat), expected, rtol=1e-14)


def test_the_bias_follows_the_anchors_number_not_the_slot():
    sensor = freeze(_sensor(2))
    inputs = {"anchors": jnp.asarray(ANCHORS[[3, 1]].ravel()), "anchor": jnp.array([3.0, 1.0])}
    ranges = sensor.measure(Placed(Vector(*POSITION)), inputs)
    expected = np.linalg.norm(POSITION - ANCHORS[[3, 1]], axis=1) + BIASES[[3, 1]]
    np.testing.assert_allclose(np.array(ranges), expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("attitude", "rotation"),
    [
        (Heading(jnp.asarray(np.pi / 2)), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        (Rotation.exp([0.0, 0.0, np.pi / 2]), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        (Rotation.exp([np.pi / 2, 0.0, 0.0]), [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    ],
    ids=["heading", "yaw", "roll"],
)
def test_a_lever_arm_turns_with_the_body(attitude, rotation):
    lever = Vector(0.3, 0.2, 0.1)
    # Rounding of sines and of π/2 itself.
    np.testing.assert_allclose(
        np.array(list(in_world_axes(attitude, lever))), rotation @ np.array([*lever]), atol=1e-15
    )

    class View:
        position = Vector(*POSITION)

    view = View()
    view.attitude = attitude
    ranges = freeze(_sensor(1)).measure(view, {**_inputs(1), "levers": jnp.array([0.3, 0.2, 0.1])})
    tag = POSITION + rotation @ np.array([0.3, 0.2, 0.1])
    np.testing.assert_allclose(float(ranges[0]), np.linalg.norm(tag - ANCHORS[0]) + BIASES[0], rtol=1e-14)


def _update(sensor, values):
    """The position after one update with all slots, from a prior with a standard deviation of 0.5 m."""
    slots = sensor.slots
    zero = jnp.zeros(())
    belief = Gaussian(Placed(Vector(*(jnp.asarray(x) for x in POSITION))), diagonal([0.25] * 3, zero))
    reading = Reading(values, jnp.ones(slots, bool), ())
    after, innovation = ExtendedKalman().update(belief, Still(), freeze(sensor), reading, _inputs(slots))
    return jnp.stack(list(after.mean.position)), innovation.nis


@pytest.fixture(scope="module")
def updated():
    sensor = _sensor(5)
    return jax.jit(lambda values: _update(sensor, values))


def test_an_outlier_is_down_weighted_and_the_other_ranges_are_used(updated):
    there = POSITION + np.array([0.2, -0.1, 0.1])
    good = np.linalg.norm(there - ANCHORS, axis=1) + BIASES
    outlier = good.copy()
    outlier[2] += 40.0
    clean, spoiled = (np.array(updated(jnp.asarray(v))[0]) for v in (good, outlier))
    # The prior shortens the step by a tenth; the linearisation error of 0.25 m at a range of 5 m is smaller.
    assert np.linalg.norm(clean - there) < 0.05
    assert np.linalg.norm(spoiled - there) < 0.1


def test_a_negative_range_error_has_more_weight_than_a_positive_one(updated):
    good = np.linalg.norm(POSITION - ANCHORS, axis=1) + BIASES
    shift = np.zeros(5)
    shift[0] = 0.3
    longer, shorter = (np.linalg.norm(np.array(updated(jnp.asarray(good + s))[0]) - POSITION) for s in (shift, -shift))
    assert shorter > 1.2 * longer


def test_a_reported_standard_deviation_counts_by_its_scale_beside_the_sensors_own():
    sensor = eqx.tree_at(lambda s: s.reported_std_scale, FixSensor(0.3, 1.2), Scale(2.0))
    reading = Reading((1.0, -0.5, 2.0), (True, True, True), (0.2**2, 0.2**2, 0.25**2))
    whitened = freeze(sensor).residual(reading, [0.0, 0.0, 0.0]).whitened
    # Twice 0.2 m beside 0.3 m are 0.5 m, twice 0.25 m beside 1.2 m are 1.3 m.
    np.testing.assert_allclose([float(x) for x in whitened], [2.0, -1.0, 2.0 / 1.3], rtol=1e-6)
