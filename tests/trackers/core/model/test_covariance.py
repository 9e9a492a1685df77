"""The two forms of a covariance against each other and against dense matrices in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.model import covariance
from trackwright.trackers.core.model.algebra import ONE, VARIABLE, ZERO, Jacobian, congruence, triangle

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
    return {"scalars": upper, "matrix": covariance.matrix(upper)}


def _jacobian(matrix):
    structure = np.where(matrix == 0, ZERO, np.where(matrix == 1, ONE, VARIABLE))
    return Jacobian(jnp.asarray(matrix.T), np.arange(len(matrix.T)), structure)


def _predicted(forms, F, G):
    """F P Fᵀ + G Gᵀ of both forms, compiled at once: one by one each operation would be."""
    jacobian, rows_of_F, rows_of_G = _jacobian(np.hstack([F, G])), _sparse(F), _sparse(G)

    @jax.jit
    def predicted(forms):
        by_entry = congruence(rows_of_F, forms["scalars"], rows_of_G)
        return covariance.propagated(forms["matrix"], jacobian), covariance.matrix(by_entry)

    return predicted(forms)


@pytest.mark.parametrize("rows", [[0, 1, 2], [1, 3], [4], []], ids=str)
def test_prediction_is_that_of_dense_matrices(problem, rows):
    P, F, G = problem
    kept, quiet = [i for i in range(N) if i not in rows], G.copy()
    F[kept], quiet[kept] = np.eye(N)[kept], 0.0
    for noise in (G, quiet):
        dense = F @ P @ F.T + noise @ noise.T
        after, by_entry = map(np.asarray, _predicted(_forms(P), F, noise))
        np.testing.assert_allclose(after, dense, rtol=1e-12)
        np.testing.assert_array_equal(after, after.T)
        np.testing.assert_allclose(by_entry, dense, rtol=1e-12)


@pytest.mark.parametrize("form", ["scalars", "matrix"])
def test_update_is_that_of_dense_matrices(problem, form):
    P, noise = problem[0], 0.3
    upper, dense_h = _forms(P)[form], np.array([0, 0.8, 0, 0, 1.0])
    h = covariance.row_for(upper, {1: jnp.asarray(0.8), 4: 1.0}, N)
    Ph = covariance.product(upper, h, N)
    np.testing.assert_allclose([float(x) for x in Ph], P @ dense_h, rtol=1e-12)
    a = dense_h @ P @ dense_h
    k, after = covariance.updated(upper, Ph, h, jnp.asarray(a), jnp.asarray(noise))
    gain = P @ dense_h / (a + noise)
    np.testing.assert_allclose([float(x) for x in k], gain, rtol=1e-12)
    I_kh = np.eye(N) - np.outer(gain, dense_h)
    expected = I_kh @ P @ I_kh.T + noise * np.outer(gain, gain)
    np.testing.assert_allclose(covariance.matrix(after), expected, rtol=1e-12)
    np.testing.assert_array_equal(covariance.matrix(after), covariance.matrix(after).T)


def test_mixture_has_the_moments_of_its_components(problem):
    P = problem[0]
    weights, deviations = (0.3, 0.7), np.random.default_rng(8).normal(size=(2, N))
    expected = sum(w * (P + np.outer(d, d)) for w, d in zip(weights, deviations, strict=True))
    for upper in _forms(P).values():
        d = [[jnp.asarray(x) for x in row] for row in deviations]
        cov = covariance.matched([jnp.asarray(w) for w in weights], [upper, upper], d)
        np.testing.assert_allclose(covariance.matrix(cov), expected, rtol=1e-12)


@pytest.mark.parametrize("form", ["scalars", "matrix"])
def test_the_leading_block_is_that_of_the_matrix(problem, form):
    P = problem[0]
    block = covariance.leading(_forms(P)[form], N, 2)
    np.testing.assert_array_equal(covariance.matrix(block), P[:2, :2])
