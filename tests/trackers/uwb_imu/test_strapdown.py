"""Strapdown mechanisation against finite differences, the paper's corrected matrix, and physics."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.state import Heading, Rotation, coordinates, local
from trackwright.trackers.core.model.tunable import Real, freeze
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown

ATTITUDE = np.array([0.9, 0.2, -0.3, 0.1]) / np.linalg.norm([0.9, 0.2, -0.3, 0.1])
PLANAR = PlanarInertial(Vector(1.0, 2.0), Vector(0.7, -0.4), Vector(0.1, -0.2), Heading(0.6), 0.05)
SPACE = Inertial(
    Vector(1.0, 2.0, 3.0), Vector(0.7, -0.4, 0.2), Rotation(*ATTITUDE), Vector(0.1, -0.2, 0.3), Vector(0.05, 0.02, -0.1)
)
INPUTS = {"accel": np.array([0.8, -1.1, 9.5]), "gyro": np.array([0.3, -0.5, 1.2]), "imu": np.ones(2)}
NOISE = ImuNoise(0.05, 0.01, 0.005, 0.001, 1.0, 0.5)
ARMED = {**INPUTS, "arm": np.array([0.3, -0.2, 0.1])}
MOTIONS = [(PlanarStrapdown(NOISE), PLANAR), (Strapdown(NOISE), SPACE)]


def _arrays(tree):
    return jax.tree_util.tree_map(jnp.asarray, tree)


def _with_imu(accel, gyro):
    return {**ARMED, "imu": np.array([accel, gyro], float)}


def _error_jacobian(motion, state, inputs, dt):
    """∂(small step after)/∂(small step before), by autodiff, as the filter takes it."""
    motion, state, inputs = freeze(motion), _arrays(state), _arrays(inputs)
    zeros = Vector.of([jnp.asarray(0.0)] * motion.noise_dimension)
    moved = motion.step(state, inputs, dt, zeros)
    point, rebuild = coordinates(state)
    _, rows = linearise(lambda *x: local(moved, motion.step(rebuild(x), inputs, dt, zeros)), point)
    return np.array([[float(row.get(j, 0.0)) for j in range(len(point))] for row in rows])


@pytest.mark.parametrize(("motion", "state"), MOTIONS)
def test_the_error_states_jacobian_is_the_finite_difference(motion, state):
    dt, h = 0.02, 1e-6
    inputs, fixed = _arrays(ARMED), freeze(motion)
    zeros = Vector.of([jnp.asarray(0.0)] * motion.noise_dimension)
    moved = fixed.step(_arrays(state), inputs, dt, zeros)
    point, rebuild = coordinates(_arrays(state))

    @jax.jit
    def after(x):
        return jnp.stack(local(moved, fixed.step(rebuild(list(x)), inputs, dt, zeros)))

    centre = jnp.stack(point)
    unit = np.eye(len(point)) * h
    differences = np.stack([(after(centre + e) - after(centre - e)) / (2 * h) for e in unit], axis=1)
    # Central differences: the cube of h times third derivatives, and rounding 1e-16/h.
    np.testing.assert_allclose(_error_jacobian(motion, state, ARMED, dt), differences, atol=1e-8)


def test_the_papers_mechanisation_has_the_papers_corrected_matrix():
    """Kwon et al. 2021, (22), (23), with f₁'s sign corrected, and zeros for the four entries of the term −ω × v."""
    psi, ax, ay = 0.6, 0.8 - 0.1, -1.1 + 0.2
    c, s = np.cos(psi), np.sin(psi)
    f1, f2 = -s * ax - c * ay, c * ax - s * ay
    F = np.zeros((8, 8))  # x, vx, bx, y, vy, by, ψ, bz
    F[0, 1] = F[3, 4] = 1
    F[1] = [0, 0, -c, 0, 0, s, f1, 0]
    F[4] = [0, 0, -s, 0, 0, -c, f2, 0]
    F[6, 7] = -1
    order = [0, 2, 4, 1, 3, 5, 6, 7]
    dt = 1e-6
    # What is left is the next power of dt, of size 1e-6.
    ours = (_error_jacobian(PlanarStrapdown(NOISE), PLANAR, INPUTS, dt) - np.eye(8)) / dt
    np.testing.assert_allclose(ours[np.ix_(order, order)], F, atol=5e-6)


def _run(motion, state, inputs, dt, steps):
    fixed, zeros = freeze(motion), Vector.of([jnp.asarray(0.0)] * motion.noise_dimension)

    @jax.jit
    def go(state, inputs):
        return jax.lax.scan(lambda x, u: (fixed.step(x, u, dt, zeros), None), state, inputs, length=steps)[0]

    return go(_arrays(state), _arrays(inputs))


def test_a_tilted_imu_at_rest_that_reads_gravity_stays_where_it_is():
    inverse = Rotation(*ATTITUDE).inverse()
    felt = np.array([float(x) for x in inverse.apply(Vector(0.0, 0.0, 9.81))])
    rest = SPACE._replace(velocity=Vector(0.0, 0.0, 0.0), gyro_bias=Vector(0.0, 0.0, 0.0))
    inputs = {"accel": felt + np.array([0.1, -0.2, 0.3]), "gyro": np.zeros(3), "imu": np.ones(2)}
    after = _run(Strapdown(NOISE), rest, {k: np.tile(v, (1000, 1)) for k, v in inputs.items()}, 0.01, 1000)
    # Ten seconds of rounding in double precision.
    np.testing.assert_allclose([*after.position, *after.velocity], [1, 2, 3, 0, 0, 0], atol=1e-10)


def test_a_body_on_a_circle_is_followed_to_second_order_in_the_step():
    radius, omega, dt = 2.0, 1.5, 0.01
    steps = round(2 * np.pi / omega / dt)
    dt = 2 * np.pi / omega / steps
    state = Inertial(
        Vector(radius, 0.0, 0.0),
        Vector(0.0, radius * omega, 0.0),
        Rotation(1.0, 0.0, 0.0, 0.0),
        *[Vector(0.0, 0.0, 0.0)] * 2,
    )
    inputs = {"accel": np.array([-radius * omega**2, 0, 9.81]), "gyro": np.array([0, 0, omega]), "imu": np.ones(2)}
    after = _run(Strapdown(NOISE), state, {k: np.tile(v, (steps, 1)) for k, v in inputs.items()}, dt, steps)
    # A step's error is third order, (ω dt)³/12 of the radius; first order in the middle would leave 0.1 m.
    np.testing.assert_allclose([*after.position], [radius, 0, 0], atol=radius * steps * (omega * dt) ** 3)
    planar = PlanarInertial(Vector(radius, 0.0), Vector(0.0, radius * omega), Vector(0.0, 0.0), Heading(0.0), 0.0)
    after = _run(PlanarStrapdown(NOISE), planar, {k: np.tile(v, (steps, 1)) for k, v in inputs.items()}, dt, steps)
    np.testing.assert_allclose([*after.position], [radius, 0], atol=radius * steps * (omega * dt) ** 3)


@pytest.mark.parametrize("stated", [0.0, 0.4, 1.0])
def test_a_tag_on_a_turning_arm_moves_while_the_imu_stands(stated):
    """The arm is that of the rig and what a fit adds to it."""
    motion = eqx.tree_at(lambda m: m.arm, Strapdown(NOISE), Real([1.0 - stated, 0.0, 0.0], "m"))
    state = Inertial(
        Vector(1.0, 0.0, 0.0), Vector(0.0, 0.0, 0.0), Rotation(1.0, 0.0, 0.0, 0.0), *[Vector(0.0, 0.0, 0.0)] * 2
    )
    inputs = {"accel": [0, 0, 9.81], "gyro": [0, 0, np.pi / 2], "imu": [1, 1], "arm": [stated, 0, 0]}
    after = _run(motion, state, {k: np.tile(np.array(v, float), (100, 1)) for k, v in inputs.items()}, 0.01, 100)
    np.testing.assert_allclose([*after.position, *after.velocity], [0, 1, 0, 0, 0, 0], atol=1e-12)


def test_two_seconds_without_an_imu_are_constant_velocity_with_white_acceleration():
    predict = jax.jit(lambda b, u: ExtendedKalman().predict(b, freeze(Strapdown(NOISE)), u, jnp.asarray(2.0)))
    belief = predict(Gaussian(_arrays(SPACE), jnp.zeros((15, 15))), _arrays({**_with_imu(0, 0), "arm": np.zeros(3)}))
    np.testing.assert_allclose([*belief.mean.position], [1 + 1.4, 2 - 0.8, 3.4], rtol=1e-12)
    # σ²T³/3, σ²T²/2, σ²T: Bar-Shalom 2001, section 6.2.2, with σ = 1.
    np.testing.assert_allclose(belief.cov[[0, 0, 3], [0, 3, 3]], [8 / 3, 2, 2], rtol=1e-12)
    np.testing.assert_allclose(belief.cov[6, 6], 0.5**2 * 2, rtol=1e-12)


@pytest.mark.parametrize("imu", [(1, 1), (1, 0), (0, 1), (0, 0)])
def test_each_missing_sensor_has_the_process_noise_of_its_own_quantity(imu):
    # A body that does not turn, so that changes in the body's axes before and after the step are the same.
    dt, inputs = 0.25, {**_with_imu(*imu), "gyro": np.array([*SPACE.gyro_bias])}
    # Root of 0.25 s is 0.5; the IMU's noise where the sensor is there, that of the motion where it is not.
    velocity, attitude = 0.5 * (0.05 if imu[0] else 1.0), 0.5 * (0.01 if imu[1] else 0.5)

    def change(motion, state, component):
        state = _arrays(state)
        noise = [[jnp.asarray(float(k == j)) for k in range(motion.noise_dimension)] for j in (None, component)]
        still, moved = (freeze(motion).step(state, _arrays(inputs), dt, Vector.of(w)) for w in noise)
        return np.array([float(x) for x in local(still, moved)])

    space, planar = Strapdown(NOISE), PlanarStrapdown(NOISE)
    for component, row, expected in ((0, 3, velocity), (8, 8, attitude), (9, 9, 0.5 * 0.005), (14, 14, 0.5 * 0.001)):
        np.testing.assert_allclose(change(space, SPACE, component)[row], expected, rtol=1e-9)
    for component, row, expected in ((1, 3, velocity), (6, 6, attitude), (4, 4, 0.5 * 0.005), (7, 7, 0.5 * 0.001)):
        np.testing.assert_allclose(change(planar, PLANAR, component)[row], expected, rtol=1e-9)


def test_the_attitude_keeps_its_length_over_a_hundred_thousand_steps_in_single_precision():
    motion = freeze(Strapdown(NOISE))
    motion = jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.float32), motion)
    single = jax.tree_util.tree_map(lambda x: jnp.asarray(x, jnp.float32), (SPACE, INPUTS))
    zeros = Vector.of([jnp.float32(0)] * 15)
    step = jnp.float32(0.01)
    go = jax.jit(
        lambda s, u: jax.lax.scan(lambda x, _: (motion.step(x, u, step, zeros), None), s, None, length=100_000)[0]
    )
    q = go(*single).attitude
    # One rounding of a single number.
    assert abs(float(q.w**2 + q.x**2 + q.y**2 + q.z**2) - 1) < 1e-6
