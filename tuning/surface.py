"""The objective round the optimum of a fit, over the two numbers that the recordings determine best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.tunable import Covariance
from tuning import FitResult
from tuning.parameters import Parameter, physical
from tuning.sweep import comparable_values
from tuning.uncertainty import Uncertainty

POINTS, FEW = 9, 6
"""Values along an axis of two, and of filters that take long; a curve over one number has twice as many."""

FINE = 61
"""Values along an axis after interpolation."""

REACH = (0.15, 2.0)
"""Least and most half width, in unconstrained numbers: from 15 % to a factor of 7 of a noise level."""


@dataclass(frozen=True)
class Surface:
    """The objective round the optimum over one tuned number, `values` (n,), or two, `values` (n, m).

    `axes`: the numbers' places in the table of tuned numbers; `grids`: their physical values.
    """

    axes: tuple[int, ...]
    grids: tuple[np.ndarray, ...]
    values: np.ndarray


def surface_of(result: FitResult, sure: Uncertainty | None) -> Surface | None:
    """The objective over one number, or over the two that are best determined; None where nothing is finite.

    As wide as the way of the best start and four standard errors, within `REACH`; cubic interpolation between the
    values over two numbers.
    """
    axes = _axes(result, sure)
    if not axes:
        return None
    count = (FEW if result.problem.width == 1 else POINTS) * (3 - len(axes))
    steps = [_half_width(result, sure, k) * np.linspace(-1, 1, count) for k in axes]
    shifts = np.stack([m.ravel() for m in np.meshgrid(*steps, indexing="ij")], axis=1)
    vectors = np.repeat(result.vector[None], len(shifts), axis=0)
    vectors[:, list(axes)] += shifts
    values = comparable_values(result.problem, vectors).reshape([count] * len(axes))
    if not np.isfinite(values).any():
        return None
    if len(axes) == 2 and np.isfinite(values).all():
        values = _finer(values)
        steps = [np.linspace(s[0], s[-1], FINE) for s in steps]
    grids = tuple(_physical(result, k, s) for k, s in zip(axes, steps, strict=True))
    return Surface(axes, grids, values)


def _axes(result: FitResult, sure: Uncertainty | None) -> tuple[int, ...]:
    """The one or two numbers of least standard error; those that moved most where that is not known."""
    free = _not_of_matrices(result.parameters)
    if not free:
        return ()
    sigmas = _sigmas(sure)
    if sigmas is not None and np.isfinite(sigmas[free]).any():
        order = sorted(free, key=lambda k: (not np.isfinite(sigmas[k]), sigmas[k]))
    else:
        way = _way(result)
        order = sorted(free, key=lambda k: -abs(float(way[-1, k] - way[0, k])))
    return tuple(sorted(order[:2]))


def _not_of_matrices(parameters: Sequence[Parameter]) -> list[int]:
    """The places in the vector that are a number each; an entry of a matrix's factor is none."""
    kinds = [isinstance(p.example, Covariance) for p in parameters for _ in range(int(np.size(p.example.raw)))]
    return [k for k, matrix in enumerate(kinds) if not matrix]


def _sigmas(sure: Uncertainty | None) -> np.ndarray | None:
    """Standard errors of the unconstrained numbers, infinite where undetermined."""
    if sure is None:
        return None
    return np.where(sure.undetermined, np.inf, sure.sigmas)


def _way(result: FitResult) -> np.ndarray:
    """The unconstrained vectors (i, p) of the best start."""
    held = [
        np.concatenate([np.ravel(p.example.with_value(step.values[p.label]).raw) for p in result.parameters])
        for step in result.trace
    ]
    return np.stack(held)


def _half_width(result: FitResult, sure: Uncertainty | None, k: int) -> float:
    sigmas = _sigmas(sure)
    wide = 4 * float(sigmas[k]) if sigmas is not None and np.isfinite(sigmas[k]) else 0.0
    moved = 1.15 * float(np.max(np.abs(_way(result)[:, k] - result.vector[k])))
    return float(np.clip(max(wide, moved), *REACH))


def _physical(result: FitResult, k: int, steps: np.ndarray) -> np.ndarray:
    """The physical values of the number `k` at steps from the optimum."""
    vectors = np.repeat(result.vector[None], len(steps), axis=0)
    vectors[:, k] += steps
    flat = jax.vmap(lambda v: jnp.concatenate([jnp.ravel(x) for x in physical(result.parameters, v)]))(vectors)
    return np.asarray(flat, float)[:, k]


def _finer(values: np.ndarray) -> np.ndarray:
    """The values (n, n) between which a cubic was laid, (FINE, FINE), by Keys's kernel (1981); ends stay at ends."""
    scale = (FINE - 1) / (len(values) - 1)
    shift = np.full(2, 0.5 - 0.5 * scale)
    found = jax.image.scale_and_translate(
        jnp.asarray(values), (FINE, FINE), (0, 1), jnp.full(2, scale), jnp.asarray(shift), "cubic", antialias=False
    )
    return np.asarray(found, float)
