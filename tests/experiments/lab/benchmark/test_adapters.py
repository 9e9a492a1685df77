"""Every adapter estimates small simulated worlds as filters and dense least squares of other forms do."""

from __future__ import annotations

import dataclasses
import warnings
from importlib import import_module
from importlib.util import find_spec

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

from trackwright.experiments.lab.benchmark.adapters import optimum, plain, robust_map, zero_velocity
from trackwright.experiments.lab.benchmark.declaration import ESTIMATORS
from trackwright.experiments.lab.benchmark.motion import Levels, diffusion, transition
from trackwright.experiments.lab.benchmark.problems import NotRead, beginning, problems
from trackwright.experiments.lab.benchmark.readings import WIDTHS, gradient, predicted
from trackwright.experiments.lab.benchmark.worlds import WORLDS, simulated

ROWS = 60
LEVELS = Levels(0.2, 0.15)


@pytest.fixture(scope="module", params=list(WORLDS))
def problem(request):
    """The first readings of a tag of each world."""
    whole = problems(simulated(request.param))[0]
    arrays = {name: getattr(whole, name)[:ROWS] for name in ("times", "values", "seen", "geometry")}
    return dataclasses.replace(whole, **arrays)


def _run(name, problem, levels=LEVELS):
    """The path of an estimator; skips without its library."""
    estimator = ESTIMATORS[name]
    if estimator.library and find_spec(estimator.library) is None:
        pytest.skip(f"{estimator.library} is not installed (extra: peers)")
    module, _, function = estimator.run.partition(":")
    with warnings.catch_warnings(), jax.numpy_rank_promotion("allow"):
        warnings.simplefilter("ignore")  # of other libraries
        made = getattr(import_module(f"trackwright.experiments.lab.benchmark.adapters.{module}"), function)
        path = made(problem, levels)
        return path() if callable(path) else path


def _joint(problem, levels=LEVELS):
    """Mean and covariance of all positions given all readings, of dense nonlinear least squares over the whole path."""
    d, n = problem.dimensions, 2 * problem.dimensions
    mean, P = beginning(problem)
    roots, F = [np.linalg.inv(np.linalg.cholesky(P))], []
    for dt in np.diff(problem.times):
        F.append(transition(d, dt))
        roots.append(np.linalg.inv(np.linalg.cholesky(diffusion(d, dt, levels.acceleration))))

    def residuals(flat):
        x = flat.reshape(-1, n)
        steps = [
            roots[0] @ (x[0] - mean),
            *(r @ (b - f @ a) for r, f, a, b in zip(roots[1:], F, x, x[1:], strict=False)),
        ]
        z = problem.values
        read = (z - predicted(problem.kind, problem.places(x[:, :d]), problem.geometry, z))[problem.seen]
        return np.concatenate([*steps, read / levels.reading])

    start = plain.states(problem, levels).ravel()
    found = least_squares(residuals, start, method="lm", xtol=1e-12, ftol=1e-12)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    at = [slice(n * row, n * row + d) for row in range(len(problem.times))]
    return found.x.reshape(-1, n)[:, :d], np.array([covariance[s, s] for s in at])


@pytest.mark.parametrize("kind", WIDTHS)
def test_gradients_are_those_of_automatic_differentiation(kind):
    rng = np.random.default_rng(1)
    place, geometry = rng.normal(size=3), rng.normal(size=WIDTHS[kind])
    if kind == "bearings":
        geometry[3:] = np.linalg.qr(geometry[3:].reshape(3, 3))[0].ravel()
    near = predicted(kind, place, geometry, np.zeros(1))
    with jax.enable_x64(True):
        automatic = jax.jacobian(lambda p: predicted(kind, p, geometry, near, jax.numpy))(place)
    np.testing.assert_allclose(gradient(kind, place, geometry), automatic, atol=1e-12)


@pytest.mark.parametrize("name", ["cuthbert", "filterpy", "stonesoup"])
def test_filters_of_the_same_model_have_the_estimates_of_the_textbook(problem, name):
    # So wide that no gate leaves a reading out.
    wide = Levels(0.2, 0.6)
    path, textbook = _run(name, problem, wide), plain.estimate(problem, wide)
    np.testing.assert_allclose(path.positions, textbook.positions, atol=1e-6)
    np.testing.assert_allclose(path.covariances, textbook.covariances, atol=1e-6)


@pytest.mark.parametrize("name", ["gtsam", "dynamax"])
def test_batch_estimates_are_those_of_dense_least_squares(problem, name):
    path, (positions, covariances) = _run(name, problem), _joint(problem)
    # Huber's loss, and the linearisation at filtered states, move them by a part of their standard deviation.
    sigma = np.sqrt(covariances[:, 0, 0].mean())
    assert np.abs(path.positions - positions).max() < sigma
    assert np.sqrt(path.covariances[:, 0, 0].mean()) == pytest.approx(sigma, rel=0.15)


def test_without_a_robust_loss_the_most_probable_path_is_that_of_dense_least_squares(problem):
    positions, _ = _joint(problem)
    np.testing.assert_allclose(robust_map.estimate(problem, LEVELS, np.inf).positions, positions, atol=2e-4)


def test_a_wild_reading_moves_robust_estimates_less(problem):
    wild = problem.values.copy()
    wild[ROWS // 2] += 1.0
    worse = dataclasses.replace(problem, values=wild)
    of_textbook, of_map = (
        np.abs(f(worse, LEVELS).positions - f(problem, LEVELS).positions).max()
        for f in (plain.estimate, robust_map.estimate)
    )
    assert of_map < 0.5 * of_textbook


def test_the_newest_state_of_a_lag_is_near_that_of_the_filter(problem):
    path, filtered = _run("gtsam-lag", problem), plain.estimate(problem, LEVELS)
    sigmas = np.sqrt(filtered.covariances[:, 0, 0])
    assert np.median(np.abs(path.positions[:, 0] - filtered.positions[:, 0]) / sigmas) < 0.5


def test_the_optimum_of_a_world_has_the_covariance_of_its_errors():
    folder = simulated("world-ranges-3d")
    squares = []
    for one in problems(folder):
        truth = folder.tables["truth"].filter(tag=one.tag).select("x_m", "y_m", "z_m").to_numpy()
        path = optimum.filtered(one, None)
        errors = path.positions - truth
        squares.append(np.einsum("ni,ni->n", errors, np.linalg.solve(path.covariances, errors[..., None])[..., 0]) / 3)
    # Errors of a path last for a second, so that three paths of 30 s are about a hundred samples of three numbers.
    assert 0.75 < np.mean(squares) < 1.25
    with pytest.raises(NotRead, match="no simulated world"):
        optimum.filtered(dataclasses.replace(one, folder=dataclasses.replace(folder, name="elsewhere")), None)


def test_zero_velocity_updates_stop_a_tag_whose_imu_is_at_rest():
    whole = problems(simulated("world-ranges-2d"))[0]
    imu = whole.folder.tables["truth"].filter(tag=whole.tag).select("t_s").with_columns(
        accel_x_mps2=0.0, accel_y_mps2=0.0, accel_z_mps2=0.0, qw=1.0, qx=0.0, qy=0.0, qz=0.0
    )  # fmt: skip
    folder = dataclasses.replace(whole.folder, tables={**whole.folder.tables, "imu": imu})
    still = np.linalg.norm(np.array([3.0, 4.0, whole.height]) - whole.geometry, axis=1)[:, None]
    path = zero_velocity.estimate(dataclasses.replace(whole, folder=folder, values=still), LEVELS)
    assert np.hypot(*(path.positions[-1] - [3.0, 4.0])) < 0.02
    assert np.abs(np.diff(path.positions[-50:], axis=0)).max() < 1e-3
