"""Diagnostics of a filter's innovations: NIS against its distribution, whiteness, and which noise assumption fails."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc, ndtri

from trackers.core.estimates import Estimates
from trackers.core.metrics import chi_square_density
from trackers.core.recording import Recording
from trackers.core.tracker import AbstractTracker
from tuning.consistency import student_t_below, student_t_dof_of

CORRELATED = 0.1
"""Correlation of neighbouring rows from which on errors count as lasting."""

SIZE = (0.75, 1.33)
"""NIS per degree of freedom outside of which the noise is of another size."""

RARE, TOO_OFTEN = 1e-3, 5.0
"""A NIS that one row in a thousand should exceed, and how many times more often is too often."""


@dataclass(frozen=True)
class Innovations:
    """NIS (n,) with degrees of freedom (n,) of rows in time order; `trajectory` (n,): whose trajectory a row is.

    `student_t_dof`: degrees of freedom of Student's t noise, whose NIS is not χ²; None for normal noise.
    """

    nis: np.ndarray
    dof: np.ndarray
    trajectory: np.ndarray
    student_t_dof: float | None = None


def innovations_of(tracker: AbstractTracker, runs: Sequence[Estimates]) -> Innovations | None:
    """Innovations of all rows with a NIS, trajectory by trajectory; None where the distribution of NIS is unknown."""
    try:
        nu = student_t_dof_of(tracker)
    except ValueError:
        return None
    used = [np.isfinite(run.nis) & (run.nis_dof > 0) & run.usable for run in runs]
    trajectory = [np.full(int(rows.sum()), k) for k, rows in enumerate(used)]
    nis, dof = (
        np.concatenate([getattr(run, name)[rows].astype(float) for run, rows in zip(runs, used, strict=True)])
        for name in ("nis", "nis_dof")
    )
    return Innovations(nis, dof, np.concatenate(trajectory), None if nu is None else float(np.asarray(nu)))


def absolute_errors(
    tracker: AbstractTracker, recording: Recording, run: Estimates, quantity: str
) -> tuple[np.ndarray, np.ndarray]:
    """Times (t,) and lengths (t,) of the errors in `quantity`: horizontal, m, or of a direction's two angles, rad.

    At the times of validity of the estimates, with the truth interpolated between rows; NaN where either is missing.
    """
    rows = recording.times
    true, known = recording.truth[quantity]
    times, valid = tracker.at_valid_time(rows, run)
    if not (hasattr(valid.mean, quantity) and known.any()):
        return times, np.full(len(times), np.nan)
    has_truth = (np.interp(times, rows, known) > 1 - 1e-9) & (times >= rows[0])
    mean = np.stack([np.asarray(x) for x in getattr(valid.mean, quantity)], axis=1)[:, :2]
    truth = np.stack([np.interp(times, rows[known], true[known, k]) for k in range(2)], axis=1)
    length = np.sqrt(((mean - truth) ** 2).sum(axis=1))
    return times, np.where(has_truth & valid.usable, length, np.nan)


def probabilities(innovations: Innovations) -> np.ndarray:
    """How likely a smaller NIS was, by each row's degrees of freedom (n,): even over 0 … 1 if consistent.

    Rows with different degrees of freedom can be looked at together in this way (Dawid 1984).
    """
    nis, dof = np.asarray(innovations.nis, float), np.asarray(innovations.dof, float)
    with jax.enable_x64(True):
        if innovations.student_t_dof is None:
            return np.asarray(gammainc(dof / 2, nis / 2))
        return np.asarray(student_t_below(jnp.asarray(nis), jnp.asarray(dof), jnp.asarray(innovations.student_t_dof)))


def normal_scores(innovations: Innovations) -> np.ndarray:
    """NIS values as the standard normal values of the same probability (n,), at most 7 from zero."""
    with jax.enable_x64(True):
        return np.asarray(ndtri(np.clip(probabilities(innovations), 1e-12, 1 - 1e-12)))


def autocorrelation(innovations: Innovations, lags: int) -> tuple[np.ndarray, int]:
    """The autocorrelation of the normal scores at 1 … `lags` rows (lags,), and how many pairs lag 1 has.

    Pairs are of one trajectory; NaN where there are none. Near zero for a filter whose model is true.
    """
    scores = normal_scores(innovations)
    centred = scores - scores.mean() if len(scores) else scores
    power = float(np.mean(centred**2)) if len(scores) else np.nan
    found, pairs = np.full(lags, np.nan), 0
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        together = innovations.trajectory[lag:] == innovations.trajectory[:-lag]
        products = (centred[lag:] * centred[:-lag])[together]
        if len(products) and power > 0:
            found[lag - 1] = products.mean() / power
        pairs = len(products) if lag == 1 else pairs
    return found, pairs


def expected_density(x: np.ndarray, innovations: Innovations) -> np.ndarray:
    """The density at positive `x` of the NIS of a consistent filter with the rows' degrees of freedom.

    A mixture of χ², or for Student's t of the beta distributions of `tuning.consistency`.
    """
    kinds, counts = np.unique(innovations.dof, return_counts=True)
    density = np.zeros(len(x))
    for dof, count in zip(kinds, counts, strict=True):
        one = (
            chi_square_density(x, float(dof))
            if innovations.student_t_dof is None
            else _student_t_density(x, float(dof), innovations.student_t_dof)
        )
        density += count / len(innovations.dof) * one
    return density


def _student_t_density(x: np.ndarray, nis_dof: float, nu: float) -> np.ndarray:
    both = 0.5 * (nis_dof * (nu + 3) - 2)
    a, reach = both / (nu + 1), nis_dof * (nu + 1)
    b = nu * a
    share = np.clip(x / reach, 1e-12, 1 - 1e-12)
    log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(both)
    density = np.exp((a - 1) * np.log(share) + (b - 1) * np.log1p(-share) - log_beta) / reach
    found: np.ndarray = np.where(x < reach, density, 0.0)
    return found


def contradicted(innovations: Innovations) -> list[str]:
    """The assumptions that the rows contradict, each as a sentence's part with the number that says so."""
    found: list[str] = []
    if not len(innovations.nis):
        return found
    lasting, pairs = autocorrelation(innovations, 1)
    if pairs and lasting[0] > max(CORRELATED, 3 / np.sqrt(pairs)):
        found.append(
            "that errors of neighbouring rows are independent "
            f"(their NIS is correlated by {lasting[0]:.2f}: errors last)"
        )
    likely = probabilities(innovations)
    # Half the rows are above the median whatever a few wild readings do.
    middle = float(np.median(likely))
    ratio = float(innovations.nis.sum() / innovations.dof.sum())
    if not SIZE[0] <= ratio <= SIZE[1] and abs(middle - 0.5) > 0.1:
        found.append(
            "that the noise is as large here as where it was tuned "
            f"(NIS per degree of freedom {ratio:.2g}, 1 if it were)"
        )
    often = float(np.mean(likely > 1 - RARE)) / RARE
    if often > TOO_OFTEN:
        found.append(f"that large errors are as rare as in its distribution ({often:.0f} times as many beyond 99.9 %)")
    return found
