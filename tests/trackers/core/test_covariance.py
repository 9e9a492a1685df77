"""The two forms of a covariance against each other and against dense matrices in NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from trackers.core import covariance
from trackers.core.algebra import triangle

N = 5


@pytest.fixture
def problem():
    rng = np.random.default_rng(7)
    root = rng.normal(size=(N, N))
    P = root @ root.T
    F = np.eye(N)
    F[0, 3], F[1, 4], F[2, 2] = 0.3, -0.7, 0.9
    G = np.zeros((N, 3))
    G[0, 0], G[3, 0], G[4, 1], G[2, 2] = 0.5, 0.2, 0.4, 0.1
    return P, F, G


def _sparse(matrix):
    """Sparse rows with the Python float 1.0 for structural ones."""
    return [{j: 1.0 if v == 1.0 else jnp.asarray(v) for j, v in enumerate(row) if v != 0.0} for row in matrix]


def _forms(P):
    upper = tuple(jnp.asarray(P[i, j]) for i, j in triangle(len(P)))
    return {"scalars": upper, "array": covariance.as_array(upper)}


@pytest.mark.parametrize("form", ["scalars", "array"])
def test_prediction_is_that_of_dense_matrices(problem, form):
    P, F, G = problem
    one, two = (_sparse(F), _sparse(G)), (_sparse(F.T), _sparse(np.zeros((N, 1))))
    after = covariance.predicted([one, two], _forms(P)[form])
    dense = F.T @ (F @ P @ F.T + G @ G.T) @ F
    np.testing.assert_allclose(covariance.matrix(after, N), dense, rtol=1e-12)


@pytest.mark.parametrize("form", ["scalars", "array"])
def test_update_is_that_of_dense_matrices(problem, form):
    P, noise = problem[0], 0.3
    h = {1: jnp.asarray(0.8), 4: 1.0}
    dense_h = np.array([0, 0.8, 0, 0, 1.0])
    Ph = covariance.product(_forms(P)[form], h, N)
    np.testing.assert_allclose([float(x) for x in Ph], P @ dense_h, rtol=1e-12)
    k = Ph * (1.0 / (dense_h @ P @ dense_h + 1.0))
    after = covariance.joseph(_forms(P)[form], Ph, k, h, jnp.asarray(noise))
    I_kh = np.eye(N) - np.outer([float(x) for x in k], dense_h)
    expected = I_kh @ P @ I_kh.T + noise * np.outer([float(x) for x in k], [float(x) for x in k])
    np.testing.assert_allclose(covariance.matrix(after, N), expected, rtol=1e-12)


def test_mixture_has_the_moments_of_its_components(problem):
    P = problem[0]
    weights, deviations = (0.3, 0.7), np.random.default_rng(8).normal(size=(2, N))
    expected = sum(w * (P + np.outer(d, d)) for w, d in zip(weights, deviations, strict=True))
    for upper in _forms(P).values():
        d = [[jnp.asarray(x) for x in row] for row in deviations]
        found = covariance.matched([jnp.asarray(w) for w in weights], [upper, upper], d)
        np.testing.assert_allclose(covariance.matrix(found, N), expected, rtol=1e-12)


@pytest.mark.parametrize("form", ["array", "scalars"])
def test_the_leading_block_is_that_of_the_matrix(form):
    rows, columns = np.triu_indices(4)
    matrix = np.arange(16.0).reshape(4, 4)
    upper = jnp.asarray(matrix[rows, columns])
    found = covariance.leading(upper if form == "array" else tuple(upper), 4, 2)
    np.testing.assert_array_equal(np.asarray(found), [0.0, 1.0, 5.0])
