"""The objective surface near the optimum of a fit, over the two best determined numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.model.tunable import Covariance
from trackwright.tuning.fitting import FitResult
from trackwright.tuning.parameters import Parameter, component_kinds, physical
from trackwright.tuning.sweeping import comparable_values
from trackwright.tuning.uncertainty import Uncertainty

POINTS, FEW = 9, 7
"""Values per axis of a surface, and where each vector is a run of its own; a curve over one number has twice as many.

Odd, so that the optimum is one of them.
"""

FINE = 61
"""Values per axis after interpolation."""

HALF_WIDTHS = (0.15, 2.0)
"""Least and largest half width, in unconstrained numbers: from 15 % to a factor of 7 of a noise level."""


@dataclass(frozen=True)
class Surface:
    """The objective near the optimum over one tuned number, `values` (n,), or two, `values` (n, m).

    `axes`: the numbers' indices in the unconstrained vector; `grids`: their physical values.
    """

    axes: tuple[int, ...]
    grids: tuple[Float[np.ndarray, " _"], ...]
    values: Float[np.ndarray, "n *m"]


def surface_of(result: FitResult, uncertainty: Uncertainty | None) -> Surface | None:
    """The objective over one number, or over the two best determined; None where no value is finite.

    Covers the best start's trace and four standard errors, within `HALF_WIDTHS`; surfaces are interpolated cubically.
    """
    axes = _axes(result, uncertainty)
    if not axes:
        return None
    count = FEW if result.problem.vectors_per_call == 1 else POINTS
    count = 2 * count - 1 if len(axes) == 1 else count
    steps = [_half_width(result, uncertainty, k) * np.linspace(-1, 1, count) for k in axes]
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


def _axes(result: FitResult, uncertainty: Uncertainty | None) -> tuple[int, ...]:
    """The one or two determined numbers of least standard error, or without any those that moved most."""
    free = _scalar_components(result.parameters)
    if not free:
        return ()
    sigmas = _sigmas(uncertainty)
    if sigmas is not None and np.isfinite(sigmas[free]).any():
        order = sorted((k for k in free if np.isfinite(sigmas[k])), key=lambda k: sigmas[k])
    else:
        trace = _trace_vectors(result)
        order = sorted(free, key=lambda k: -abs(float(trace[-1, k] - trace[0, k])))
    return tuple(sorted(order[:2]))


def _scalar_components(parameters: Sequence[Parameter]) -> list[int]:
    """The indices of numbers that are no entries of a matrix's factor."""
    return [k for k, kind in enumerate(component_kinds(parameters)) if not issubclass(kind, Covariance)]


def _sigmas(uncertainty: Uncertainty | None) -> Float[np.ndarray, " p"] | None:
    """Standard errors of the unconstrained numbers, infinite where undetermined."""
    if uncertainty is None:
        return None
    return np.where(uncertainty.undetermined, np.inf, uncertainty.sigmas)


def _trace_vectors(result: FitResult) -> Float[np.ndarray, "i p"]:
    """The unconstrained vectors (i, p) of the best start's trace."""
    vectors = [
        np.concatenate([np.ravel(p.example.with_value(step.values[p.label]).raw) for p in result.parameters])
        for step in result.trace
    ]
    return np.stack(vectors)


def _half_width(result: FitResult, uncertainty: Uncertainty | None, k: int) -> float:
    sigmas = _sigmas(uncertainty)
    wide = 4 * float(sigmas[k]) if sigmas is not None and np.isfinite(sigmas[k]) else 0.0
    moved = 1.15 * float(np.max(np.abs(_trace_vectors(result)[:, k] - result.vector[k])))
    return float(np.clip(max(wide, moved), *HALF_WIDTHS))


def _physical(result: FitResult, k: int, steps: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The physical values of the number `k` at `steps` from the optimum."""
    vectors = np.repeat(result.vector[None], len(steps), axis=0)
    vectors[:, k] += steps
    flat = jax.vmap(lambda v: jnp.concatenate([jnp.ravel(x) for x in physical(result.parameters, v)]))(vectors)
    return np.asarray(flat, float)[:, k]


def _finer(values: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "fine fine"]:
    """The values (n, n) interpolated cubically to (FINE, FINE), with the same end points (Keys 1981)."""
    scale = (FINE - 1) / (len(values) - 1)
    shift = np.full(2, 0.5 - 0.5 * scale)
    found = jax.image.scale_and_translate(
        jnp.asarray(values), (FINE, FINE), (0, 1), jnp.full(2, scale), jnp.asarray(shift), "cubic", antialias=False
    )
    return np.asarray(found, float)
