"""Hyperbolic positioning: positions from range differences, in closed form and refined, many at once on the host.

Closed form: Schau and Robinson 1987; Chan and Ho 1994. Refinement: Gauss–Newton on the Cauchy loss, as for ranges
(`parts/multilaterate.py`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.parts.multilaterate import CAUCHY_SCALE, FURTHEST, RIDGE

MIN_INFORMATION = 1e-3
"""Smallest eigenvalue of the horizontal information matrix, per difference, at which a position is determined.

Thirty differences of 0.13 m then leave 0.75 m; beside the anchors a difference tells less than a range.
"""

ITERATIONS = 15
"""Gauss–Newton steps by the distances from the reference, and a third as many for these, and by all differences."""


class Differences(NamedTuple):
    """Range differences of M epochs, m: `values` (M, S) where `counts` (M, S).

    `first`, `second` (M, S): the numbers in `anchors` (A, 3), m, of the anchors whose distances differ by them.
    """

    values: Float[np.ndarray, "M S"]
    counts: Bool[np.ndarray, "M S"]
    first: Int[np.ndarray, "M S"]
    second: Int[np.ndarray, "M S"]
    anchors: Float[np.ndarray, "A 3"]


def hyperbolic_positions(
    given: Differences, heights: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "M 3"], Bool[np.ndarray, " M"]]:
    """The position of least Cauchy loss of each epoch, m, and whether its differences determine it.

    `heights` (M,) m: known ones, all or none NaN. Two hyperbolas may meet twice, and coplanar anchors have mirror
    images: both roots of the closed form, and points below and above the anchors' centroid, are refined, and the one of
    least cost is kept, of equal ones the lower. It is determined where one anchor more than its unknowns need agrees.
    """
    n = 3 if np.isnan(heights).all() else 2
    heard, ranges, reference = _from_reference(given)
    starts = np.concatenate(
        [_around(given.anchors, heard, heights), _closed_form(given.anchors, heard, ranges, reference, heights)]
    )
    # Most steps with a few distances in the place of many differences.
    to_all = np.broadcast_to(np.arange(len(given.anchors)), heard.shape)
    of_reference = Differences(ranges, heard, to_all, np.broadcast_to(reference[:, None], heard.shape), given.anchors)
    place = _refined(of_reference, starts, n, ITERATIONS)
    cost = np.sum(given.counts * np.log1p((_linearised(given, place, n)[0] / CAUCHY_SCALE) ** 2), axis=-1)
    best = np.argmin(cost + 1e-3 * np.arange(len(starts))[:, None], axis=0)
    epochs = np.arange(len(best))
    place = _refined(given, place[best, epochs][None], n, ITERATIONS // 3)[0]
    residual, jacobian = _linearised(given, place, n)
    scale = _scale(residual, given.counts)
    agree = given.counts & (np.abs(residual) <= FURTHEST * scale[:, None])
    information = np.einsum("ms,msi,msj->mij", agree, jacobian, jacobian)
    information = information / np.maximum(agree.sum(axis=1), 1)[:, None, None]
    horizontal = information[:, :2, :2]
    if n == 3:
        # What is left of the horizontal information where the height is estimated, too.
        xy_z = information[:, :2, 2]
        horizontal = horizontal - np.einsum("mi,mj,m->mij", xy_z, xy_z, 1.0 / (information[:, 2, 2] + RIDGE))
    smallest = np.linalg.eigvalsh(horizontal)[:, 0]
    agreeing = np.zeros((len(best), len(given.anchors)), bool)
    for numbers in (given.first, given.second):
        np.logical_or.at(agreeing, (epochs[:, None], numbers), agree)
    determined = ((agreeing & heard).sum(axis=1) >= n + 2) & (smallest > MIN_INFORMATION)
    return place, determined & np.isfinite(place).all(axis=1)


def _from_reference(given: Differences) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The anchors connected with the reference (M, A), their distances less its own (M, A), m, and which it is (M,).

    The reference is the anchor with most differences. By weighted least squares over all pairs, robust as `_refined`.
    """
    M, A = len(given.values), len(given.anchors)
    epoch = np.arange(M)[:, None]
    joined = np.zeros((M, A, A))
    np.add.at(joined, (epoch, given.first, given.second), given.counts)
    joined = joined + joined.transpose(0, 2, 1)
    reference = np.argmax(joined.sum(axis=2), axis=1)
    reach = (joined > 0) | np.eye(A, dtype=bool)
    for _ in range(int(A).bit_length()):
        reach = np.einsum("mij,mjk->mik", reach, reach) > 0
    heard = reach[epoch[:, 0], reference]
    distances: np.ndarray = np.zeros((M, A))
    weight = given.counts.astype(float)
    for _ in range(ITERATIONS // 3):
        normal, right = np.tile(1e-9 * np.eye(A), (M, 1, 1)), np.zeros((M, A))
        for one, other, sign in ((given.first, given.second, 1.0), (given.second, given.first, -1.0)):
            np.add.at(normal, (epoch, one, one), weight)
            np.add.at(normal, (epoch, one, other), -weight)
            np.add.at(right, (epoch, one), sign * weight * given.values)
        distances = np.linalg.solve(normal, right[..., None])[..., 0]
        residual = given.values - distances[epoch, given.first] + distances[epoch, given.second]
        weight = given.counts / (1.0 + (residual / _scale(residual, given.counts)[..., None]) ** 2)
    return heard, distances - distances[epoch, reference[:, None]], reference


def _closed_form(
    anchors: np.ndarray, heard: np.ndarray, ranges: np.ndarray, reference: np.ndarray, heights: np.ndarray
) -> np.ndarray:
    """Both positions (2, M, 3), m, that the distances less the reference's, `ranges` (M, A) m, imply.

    With b the anchors and y the tag from the reference, at the distance ρ: 2 b·y + 2 δρ = |b|² − δ². Least squares give
    y = p + qρ, and |y| = ρ a quadratic equation.
    """
    known = np.isfinite(heights)
    n = 2 if known.all() else 3
    origin = anchors[reference]
    b = np.where(heard[..., None], anchors[None] - origin[:, None], 0.0)
    delta = np.where(heard, ranges, 0.0)
    z = np.where(known, heights - origin[:, 2], 0.0)
    right = np.stack(
        [0.5 * (np.einsum("mak,mak->ma", b, b) - delta**2) - b[..., 2] * z[:, None] * known[:, None], -delta]
    )
    p, q = np.einsum("mka,cma->cmk", np.linalg.pinv(b[..., :n], rcond=1e-3), right)
    pp, pq, qq = (np.einsum("mk,mk->m", x, y) for x, y in ((p, p), (p, q), (q, q)))
    root = np.sqrt(np.maximum(pq**2 - (qq - 1.0) * (pp + z**2), 0.0))
    # ρ = (pp + z²)/(−pq ± root), of which both signs are finite where one root is at infinity.
    rho = np.stack([(pp + z**2) / np.where(np.abs(d) > 1e-9, d, 1e-9) for d in (-pq + root, -pq - root)])
    limit = 3.0 * np.ptp(anchors, axis=0).max()
    place = p + q * np.clip(rho, 0.0, limit)[..., None]
    if n == 2:
        place = np.concatenate([place, np.broadcast_to(z[..., None], (2, len(z), 1))], axis=2)
    return np.asarray(place + origin)


def _around(anchors: np.ndarray, heard: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Points below and above the centroid of the anchors that are heard (2, M, 3), m, or at the known height."""
    count = np.maximum(heard.sum(axis=1), 1)[:, None]
    centroid = heard @ anchors / count
    spread = np.sqrt(np.einsum("ma,mak->m", heard, (anchors - centroid[:, None])[..., :2] ** 2) / count[:, 0])
    z = [np.where(np.isfinite(heights), heights, centroid[:, 2] + sign * spread) for sign in (-1.0, 1.0)]
    return np.stack([np.column_stack([centroid[:, :2], height]) for height in z])


def _refined(given: Differences, starts: np.ndarray, n: int, steps: int) -> np.ndarray:
    """Positions (H, M, 3) after robust Gauss–Newton steps of n axes from H starts each."""
    place, eye = starts.copy(), RIDGE * np.eye(n)
    # A hyperbola is straight far away: no step is longer than the installation.
    longest = np.ptp(given.anchors, axis=0).max()
    for _ in range(steps):
        residual, jacobian = _linearised(given, place, n)
        weight = given.counts / (1.0 + (residual / _scale(residual, given.counts)[..., None]) ** 2)
        weighted = weight[..., None] * jacobian
        normal = np.einsum("hmsi,hmsj->hmij", weighted, jacobian) + eye
        move = np.linalg.solve(normal, np.einsum("hmsi,hms->hmi", weighted, residual)[..., None])[..., 0]
        move /= np.maximum(np.linalg.norm(move, axis=-1, keepdims=True) / longest, 1.0)
        place[..., :n] += move
    return place


def _linearised(given: Differences, place: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (…, M, S), m, zero where none counts, and the derivatives of the differences (…, M, S, n)."""
    distances, towards = [], []
    for numbers in (given.first, given.second):
        away = place[..., None, :] - given.anchors[numbers]
        distance = np.sqrt(np.maximum(np.einsum("...k,...k", away, away), 1e-12))
        distances.append(distance)
        towards.append(away[..., :n] / distance[..., None])
    residual = given.counts * (given.values - distances[0] + distances[1])
    return residual, towards[0] - towards[1]


def _scale(residual: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The scale of the loss (…, M), m: `CAUCHY_SCALE`, at least 1.5 times the median residual."""
    size = np.sort(np.where(counts, np.abs(residual), np.inf), axis=-1)
    middle = np.maximum(counts.sum(axis=-1) - 1, 0) // 2
    middle = np.broadcast_to(middle, size.shape[:-1])
    median = np.take_along_axis(size, middle[..., None], axis=-1)[..., 0]
    return np.maximum(1.5 * np.where(np.isfinite(median), median, 0.0), CAUCHY_SCALE)
