"""In words: what of a fit the recordings determine, and what they leave open."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from trackers.core.tunable import Scale
from tuning.parameters import Parameter
from tuning.uncertainty import PART, Uncertainty, determined, unused, without_effect

LOOSE = 1.0
"""Standard deviation of an unconstrained number from which on it is hardly determined: a factor of e either way."""


@dataclass(frozen=True)
class IdentifiabilityIssue:
    """What is wrong with a direction: `names` of the numbers that have a part in it, and what to tell the user."""

    names: tuple[str, ...]
    text: str


def identifiability_issues(found: Uncertainty, slopes: np.ndarray) -> list[IdentifiabilityIssue]:
    """What the recordings don't determine, worst first; nothing to say of a good fit.

    `slopes` (…, p, n): derivatives of trajectories' terms, as of `Evaluations`; where all are zero a number has no
    effect at all.
    """
    names, kinds = names_of(found.parameters), kinds_of(found.parameters)
    idle, void = without_effect(slopes), unused(found.parameters)
    nothing = np.flatnonzero(idle & ~void)
    without = [names[k] for k in nothing]
    said = [IdentifiabilityIssue(tuple(without), f"{_listed(without)} on the objective")] if without else []
    slope = found.optimum.gradient
    said += [IdentifiabilityIssue((names[k],), _at_its_bound(names[k], slope[k])) for k in np.flatnonzero(found.held)]
    if not found.settled:
        return [*said, IdentifiabilityIssue((), _elsewhere(found.distance_to_optimum))]
    lively = np.flatnonzero(~idle & ~void & ~found.held)
    if not len(lively) or not np.all(np.isfinite(found.optimum.hessian)):
        return said
    missing, _, _ = determined(found.optimum.hessian[np.ix_(lively, lively)])
    cov = found.observed if np.all(np.isfinite(found.observed)) else found.sandwich
    loose = np.zeros((len(lively), 0))
    deviations: list[float] = []
    if np.all(np.isfinite(cov)):
        variances, directions = np.linalg.eigh(cov[np.ix_(lively, lively)])
        wide = variances > LOOSE**2
        loose, deviations = directions[:, wide][:, ::-1], np.sqrt(variances[wide])[::-1].tolist()
    # Directions in which the same numbers have a part are spoken of together.
    together: dict[tuple[int, ...], list[tuple[np.ndarray, float]]] = {}
    for direction, deviation in zip([*missing.T, *loose.T], [math.inf] * missing.shape[1] + deviations, strict=True):
        part = np.abs(direction) > PART
        together.setdefault(tuple(lively[part].tolist()), []).append((direction[part], deviation))
    for own, ways in together.items():
        mine, theirs = [names[k] for k in own], [kinds[k] for k in own]
        if len(ways) == len(own) > 1:
            said.append(IdentifiabilityIssue(tuple(mine), _nothing(mine, min(deviation for _, deviation in ways))))
        else:
            said += [IdentifiabilityIssue(tuple(mine), _words(mine, theirs, *way)) for way in ways]
    return said


def names_of(parameters: Sequence[Parameter]) -> list[str]:
    """A name for each unconstrained number: the parameter's label, with indices where it has several."""
    return [".".join([p.label, *map(str, index)]) for p in parameters for index in np.ndindex(*np.shape(p.example.raw))]


def kinds_of(parameters: Sequence[Parameter]) -> list[type]:
    """The kind of tunable of each unconstrained number."""
    return [type(p.example) for p in parameters for _ in range(int(np.size(p.example.raw)))]


def _elsewhere(distance_to_optimum: float) -> str:
    away = f"{distance_to_optimum:.2g} standard deviations away" if distance_to_optimum < 100 else "far away"
    return (
        f"the numbers are not where the objective is least on the recordings tuned on ({away}), and have no intervals: "
        "held-out recordings chose them, or the fit ended early, as it does where the objective is not smooth"
    )


def _at_its_bound(name: str, gradient: float) -> str:
    return f"{name} rests on its bound: the recordings would have it {'lower' if gradient > 0 else 'higher'}"


def _degree(deviation: float) -> str:
    return "not determined" if math.isinf(deviation) else "hardly determined"


def _nothing(names: list[str], deviation: float) -> str:
    """Of numbers that are as open as they are many; `deviation`: of what is best known of them."""
    together = "together" if len(names) == 2 else "in any combination"
    return f"{', '.join(names[:-1])} and {names[-1]} are {_degree(deviation)}, neither one by one nor {together}"


def _words(names: list[str], kinds: list[Any], direction: np.ndarray, deviation: float) -> str:
    degree = _degree(deviation)
    if len(names) == 1:
        if math.isinf(deviation):
            return f"{names[0]} is {degree}: near this value the objective does not depend on it"
        if kinds[0] is Scale:
            return f"{names[0]} is {degree}: it may as well be {_factor(deviation)} times larger or smaller"
        return f"{names[0]} is {degree}"
    if len(names) == 2 and all(kind is Scale for kind in kinds):
        return f"{names[0]} and {names[1]} are {degree} one by one: the data fix only {_product(names, direction)}"
    size = direction / np.abs(direction).max()
    moves = ", ".join(f"{name} {_change(kind, s)}" for name, kind, s in zip(names, kinds, size, strict=True))
    return (
        f"{', '.join(names[:-1])} and {names[-1]} are {degree} one by one: changed together ({moves}) they do nothing"
    )


def _listed(names: list[str]) -> str:
    """That one or several numbers have no effect, at most four of them by name."""
    if len(names) == 1:
        return f"{names[0]} has no effect"
    shown, rest = (names[:-1], names[-1]) if len(names) <= 4 else (names[:3], f"{len(names) - 3} others")
    return f"{', '.join(shown)} and {rest} have no effect"


def _factor(deviation: float) -> str:
    return f"{math.exp(min(deviation, 20.0)):.2g}"


def _product(names: list[str], direction: np.ndarray) -> str:
    """What stays the same along the direction: one name times a power of the other, not above 1."""
    first = int(np.argmin(np.abs(direction)))
    power = -float(direction[first] / direction[1 - first])
    size = abs(power)
    other = names[1 - first] if size > 0.95 else f"{names[1 - first]}^{size:.2g}"
    return f"{names[first]} {'×' if power > 0 else '/'} {other}"


def _change(kind: Any, size: float) -> str:
    return f"{100 * (math.exp(0.1 * size) - 1):+.0f} %" if kind is Scale else f"{0.1 * size:+.2g} units"
