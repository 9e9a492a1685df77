"""Filters of matrices and plain functions, against joint conditioning of all rows, an EKF in NumPy and the Nile."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trackwright as tw

RNG = np.random.default_rng(3)
F, H, R = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[1.0, 0.0]]), np.array([[0.4]])
Q, B = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.0], [1.0]])
X0, P0 = np.array([1.0, -1.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
Z = RNG.normal(size=40).cumsum()
Z[[0, 7, 8, 30]] = np.nan
U = RNG.normal(size=40)

NILE = np.fromstring(
    "1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 1100 1210 1150 1250 "
    "1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 831 726 456 824 702 1120 1100 832 764 821 "
    "768 845 864 862 698 845 744 796 1040 759 781 865 845 944 984 897 822 1010 771 676 649 846 812 742 801 1040 860 "
    "874 848 890 744 749 838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740",
    sep=" ",
)
"""Annual flow of the Nile at Aswan, 1871 to 1970, 10⁸ m³ (Durbin and Koopman 2012, section 2.2)."""


def _kalman(steps, measured, x=X0, P=P0):
    """Means, covariances and log-likelihood: `steps` (F, Q, shift) before each row but the first, `measured` (z, H, R)."""
    means, covs, total = [], [], 0.0
    for k, (forward, noise, shift) in enumerate(steps):
        if k:
            x, P = forward @ x + shift, forward @ P @ forward.T + noise
        for z, h, r in measured[k]:
            if np.isfinite(z).all():
                S, miss = h @ P @ h.T + r, z - h @ x
                gain = np.linalg.solve(S, h @ P).T
                total -= 0.5 * (miss @ np.linalg.solve(S, miss) + np.linalg.slogdet(2 * np.pi * S)[1])
                x, P = x + gain @ miss, P - gain @ S @ gain.T
        means, covs = [*means, x], [*covs, P]
    return np.array(means), np.array(covs), total


def _numbers(estimates, name="x"):
    return np.stack([np.asarray(part) for part in getattr(estimates.mean, name)], axis=-1)


def _rows(z, h=H, r=R):
    return [[(np.atleast_1d(v), h, r)] for v in z]


def _linear(*arguments, **options):
    return tw.linear(*arguments, x0=X0, P0=P0, **options)


SINGULAR = np.array([[0.25, 0.5], [0.5, 1.0]])
TIMES = np.cumsum(RNG.uniform(0.1, 2.0, 40))
DT = np.diff(TIMES, prepend=TIMES[0])
BY_ROW = F + 0.1 * RNG.normal(size=(40, 2, 2))
TWO = np.array([[0.0, 1.0], [1.0, 1.0]])
SLOW = np.where(np.arange(40)[:, None] % 5 == 0, RNG.normal(size=(40, 2)), np.nan)


def _transition(dt):
    return jnp.array([[1.0, dt], [0.0, 1.0]])


CASES = {
    "full": (_linear(F, H, Q, R), tw.series(Z), [(F, Q, 0.0)] * 40, _rows(Z)),
    "control": (_linear(F, H, Q, R, B=B), tw.series(Z, u=U), [(F, Q, B[:, 0] * u) for u in U], _rows(Z)),
    "singular": (_linear(F, H, SINGULAR, R), tw.series(Z), [(F, SINGULAR, 0.0)] * 40, _rows(Z)),
    "one noise": (_linear(F, H, np.diag([0.0, 0.3]), R), tw.series(Z), [(F, np.diag([0.0, 0.3]), 0.0)] * 40, _rows(Z)),
    "by dt": (
        _linear(_transition, H, (lambda dt, q: q**2 * dt * jnp.array(Q), {"q": 1.5}), R),
        tw.series(Z, times=TIMES),
        [(np.array([[1.0, dt], [0.0, 1.0]]), 2.25 * dt * Q, 0.0) for dt in DT],
        _rows(Z),
    ),
    "by row": (
        _linear(lambda dt, row: row["A"], H, Q, R),
        tw.series(Z, A=BY_ROW),
        [(a, Q, 0.0) for a in BY_ROW],
        _rows(Z),
    ),
    "two sensors": (
        _linear(F, {"fast": H, "slow": TWO}, Q, {"fast": R, "slow": Q}),
        tw.series({"fast": Z, "slow": SLOW}),
        [(F, Q, 0.0)] * 40,
        [[(np.atleast_1d(a), H, R), (b, TWO, Q)] for a, b in zip(Z, SLOW, strict=True)],
    ),
    "masked": (
        _linear(F, H, Q, R),
        tw.series(np.ma.array(np.nan_to_num(Z, nan=-999.0), mask=np.isnan(Z)), truth={"x": np.ones((40, 2))}),
        [(F, Q, 0.0)] * 40,
        _rows(Z),
    ),
    "reported": (_linear(F, H, Q, R), tw.series(Z, std=np.full(40, 0.7)), [(F, Q, 0.0)] * 40, _rows(Z, r=R + 0.49)),
    "precise": (_linear(F, H, Q, [[1e-9]]), tw.series(Z), [(F, Q, 0.0)] * 40, _rows(Z, r=np.array([[1e-9]]))),
}


@pytest.mark.parametrize("case", CASES)
def test_a_filter_of_matrices_is_the_textbook_s(case):
    tracker, recording, steps, measured = CASES[case]
    means, covs, likelihood = _kalman(steps, measured)
    found = tracker.run(recording)
    np.testing.assert_allclose(_numbers(found), means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.sigmas["x.0"] ** 2, covs[:, 0, 0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(np.sum(found.log_likelihood), likelihood, rtol=1e-9)


def test_a_filter_of_functions_is_an_extended_kalman_filter():
    def step(x, dt):
        return jnp.array([x[0] + dt * x[1], x[1] - 0.1 * dt * jnp.sin(x[0])])

    tracker = tw.nonlinear(step, lambda x: [jnp.hypot(x[0], 1.0)], Q, R, x0=X0, P0=P0)
    z = np.abs(Z) + 1.0
    x, P, means = X0, P0, []
    for k, value in enumerate(z):
        if k:
            forward = np.array([[1.0, 1.0], [-0.1 * np.cos(x[0]), 1.0]])
            x, P = np.array([x[0] + x[1], x[1] - 0.1 * np.sin(x[0])]), forward @ P @ forward.T + Q
        if np.isfinite(value):
            h = np.array([[x[0] / np.hypot(x[0], 1.0), 0.0]])
            gain = P @ h.T / (h @ P @ h.T + R)
            x, P = x + gain[:, 0] * (value - np.hypot(x[0], 1.0)), P - gain @ h @ P
        means.append(x)
    np.testing.assert_allclose(_numbers(tracker.run(tw.series(z))), means, rtol=1e-9, atol=1e-9)


def test_a_fit_finds_the_nile_s_levels():
    tracker = tw.linear([[1.0]], [[1.0]], [[1000.0]], [[10000.0]], x0=[0.0], P0=[[1e7]])
    result = tw.fit(tracker, [tw.series(NILE)], "nll", ("motion.Q.*", "sensors.*.R.*"))
    # Durbin and Koopman 2012, section 2.10.3: variances 1469.1 and 15098.5, log-likelihood −641.585.
    assert np.sum(result.tracker.run(tw.series(NILE)).log_likelihood) > -641.587
    np.testing.assert_allclose(result.values["motion.Q.sigma"] ** 2, 1469.1, rtol=0.03)
    np.testing.assert_allclose(result.values["sensors.z.R.sigma"] ** 2, 15098.5, rtol=0.01)


def test_parts_of_the_state_have_names_and_positions_are_scored():
    truth = RNG.normal(size=(30, 2)).cumsum(axis=0)
    step, half = np.kron([[1.0, 0.1], [0.0, 1.0]], np.eye(2)), np.eye(2, 4)
    tracker = tw.linear(step, half, 0.1 * np.eye(4), np.eye(2), state={"position": 2, "velocity": 2})
    found = tracker.run(tw.series(truth + RNG.normal(size=(30, 2)), truth={"position": truth}))
    assert found.mean._fields == ("position", "velocity")
    assert set(tw.tunables(tracker)) >= {"motion.Q.sigma", "sensors.z.R.sigma"}
    state = jax.tree_util.tree_map(lambda x: jnp.asarray(x[0]), found.mean)
    tw.check_motion(tracker.motion, state)
    tw.check_sensor(tracker.sensors["z"], state)


def test_a_singular_covariance_in_single_precision_may_be_indefinite_by_rounding():
    rounded = np.outer([1.0, 0.3], [1.0, 0.3]).astype(np.float32)
    assert np.linalg.eigvalsh(rounded.astype(float))[0] < -1e-9
    assert _linear(F, H, rounded, R).motion.Q.sigma.value == 1.0


@pytest.mark.parametrize(
    ("make", "phrase"),
    [
        (lambda: tw.linear(F, H, np.eye(3), R), r"Q has shape \(3, 3\); expected \(2, 2\)"),
        (lambda: tw.linear(F, np.ones((1, 3)), Q, R), "H of z has shape"),
        (lambda: tw.linear(F, H, Q, [[0.0]]), "is singular; expected noise in every number"),
        (lambda: tw.linear(F, H, -Q, R), "expected a symmetric covariance"),
        (lambda: tw.linear(F, H, lambda dt: dt * (jnp.ones((2, 2)) - jnp.eye(2)), R), "Q = .* positive semidefinite"),
        (lambda: tw.linear(F, H, Q, lambda dt: jnp.array([[1 / dt]])), "R of z changes with dt; .* a std by row"),
        (lambda: _linear(lambda dt: np.array([[1, dt], [0, 1]]), H, Q, R).run(tw.series(Z)), "of jax.numpy, as jnp.ar"),
        (lambda: tw.linear(F, {"a": H}, Q, R), "sensors a and R of z; expected the same names"),
        (lambda: tw.linear(F, H, Q, R, x0=[0.0]), "a state of 2 numbers"),
        (lambda: tw.linear(F, H, Q, R, state={"position": 3}), "a state of 2 numbers"),
        (lambda: tw.linear(F, H, Q, R, state={"my state": 2}), "named as variables"),
        (lambda: tw.evaluate({"x": [1.0]}, tw.series(Z)), "found dict; expected estimates"),
        (lambda: tw.stack(F), "found ndarray; expected one or more recordings"),
        (lambda: tw.linear(F, H, Q, R, P0=[[1.0, 2.0], [2.0, 1.0]]), "P0 = .* expected a symmetric covariance"),
        (lambda: tw.linear(F, H, 1e-9 * np.array([[1.0, 0.5], [0.0, 1.0]]), R), "Q = .* a symmetric covariance"),
        (lambda: _linear(F, TWO, Q, R).run(tw.series(Z)), r"predicted measurement has shape \(2,\); expected \(1\)"),
        (lambda: _linear(lambda dt: jnp.eye(3), H, Q, R).run(tw.series(Z)), r"F has shape \(3, 3\); expected \(2, 2\)"),
        (lambda: _linear(F, H, Q, R, B=B).run(tw.series(Z, u=np.ones((40, 2)))), "u of a row has shape"),
        (lambda: tw.nonlinear(lambda x, dt: x[:1], lambda x: x[:1], Q, R, x0=X0).run(tw.series(Z)), "after a step"),
        (lambda: tw.series(np.ones((40, 2)), std=np.ones((2, 40))), r"std has shape \(2, 40\); expected \(40, 2\)"),
        (lambda: tw.series({"a": Z}, std=np.ones(40)), "std of z; expected that of a"),
        (lambda: tw.series([1.0, np.inf]), "values of z: row 1 is infinite"),
        (lambda: _linear(F, H, Q, R, B=B).run(tw.series(Z)), "u"),
        (lambda: _linear(F, H, Q, R).run(tw.series(Z, u=np.ones(40))), "has an input u, but the tracker has no B"),
        (lambda: _linear(F, H, Q, R).run(tw.series({"y": Z})), "z"),
        (lambda: _free(0.0).run(tw.series(Z, u=np.ones(40))), "has an input u, but the tracker has no function"),
        (lambda: tw.series(Z, truth=Z), "expected truth by part of the state, as"),
    ],
)
def test_what_does_not_fit_is_one_line(make, phrase):
    with pytest.raises(tw.UnusableInput, match=phrase):
        make()


def _free(offset):
    return tw.nonlinear(lambda x, dt, a=offset: x + a, lambda x, b=offset: x[:1] + b, Q, R, x0=X0)


def test_a_number_that_a_function_has_by_default_is_its_own():
    moved = [float(_free(offset).run(tw.series([np.nan, np.nan])).mean.x[0][1]) for offset in (0.0, 2.0)]
    assert moved[1] - moved[0] == 2.0


def test_single_precision_begins_with_a_variance_that_it_holds_beside_matrices():
    with jax.enable_x64(False):
        trackers = tw.linear(F, H, Q, 1e-6), tw.linear(F, H, Q, R), _free(0.0)
    precise, of_matrices, of_functions = (tracker.start.upper[0] for tracker in trackers)
    assert of_matrices == pytest.approx(2.0**15 * np.min(R) / np.max(np.square(H)), rel=1e-6)
    # Less would take the state for known: a velocity of 1 m/s as 0 ± 0.02 beside an encoder.
    assert precise == 1e3 < of_matrices
    assert of_functions == tw.linear(F, H, Q, R).start.upper[0] == 1e6
