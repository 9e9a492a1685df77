"""Jacobians of small functions by forward mode, as sparse rows or as an array, and covariances through them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.jax_private import is_literal
from trackwright.trackers.core.model.algebra import (
    ONE,
    VARIABLE,
    ZERO,
    Jacobian,
    Scalar,
    SparseRow,
    full,
    times,
    total,
    triangle,
)
from trackwright.trackers.core.model.covariance import AnyCovariance, as_scalars, size_of
from trackwright.trackers.core.model.state import State, coordinates, steps_of


def linearise(
    function: Callable[..., Sequence[Scalar]], point: Sequence[Scalar]
) -> tuple[list[Scalar], list[SparseRow]]:
    """The value of `function(*point)` and its Jacobian, one sparse row per output.

    `function` takes and returns scalars and is traced once. Each column of the Jacobian is then read off the linear
    program of `jax.linearize`, without computing structural zeros: a constant-velocity step of four components costs
    two products, not sixteen.
    """
    point = [jnp.asarray(x) for x in point]
    value, tangent_map = jax.linearize(lambda *x: list(function(*x)), *point)
    program = jax.make_jaxpr(tangent_map)(*point)
    rows: list[SparseRow] = [{} for _ in value]
    for column in range(len(point)):
        unit = [1.0 if k == column else None for k in range(len(point))]
        for row, tangent in zip(rows, _push(program.jaxpr, program.consts, unit), strict=True):
            if tangent is not None:
                row[column] = tangent
    return value, rows


def jacobian(function: Callable[..., State], point: Sequence[Scalar]) -> tuple[State, Jacobian]:
    """The state `function(*point)`, and the Jacobian of its small steps.

    Columns without a common row are computed together (Curtis, Powell and Reid 1974), all these groups at once: few
    operations, the form for few trajectories.
    """
    point = [jnp.asarray(x) for x in point]
    state, tangent_map = jax.linearize(function, *point)

    def small_step(*unit: Scalar) -> list[Scalar]:
        return steps_of(state, tangent_map(*unit))

    n = len(point)
    kinds_of_outputs = _structure(jax.make_jaxpr(small_step)(*point).jaxpr, [{k: ONE} for k in range(n)])
    structure = np.array([[kinds.get(j, ZERO) for j in range(n)] for kinds in kinds_of_outputs]).reshape(-1, n)
    group = _groups(structure != ZERO)
    seeds = jnp.asarray(group[:, None] == np.arange(group.max() + 1), point[0].dtype)
    sums = jax.vmap(lambda *unit: jnp.stack(small_step(*unit)))(*seeds)
    return state, Jacobian(sums, group, structure)


def _groups(present: np.ndarray) -> np.ndarray:
    """A group for each column of a pattern (outputs, inputs), such that columns of one group have no row in common."""
    group = np.zeros(present.shape[1], int)
    rows: list[np.ndarray] = []
    for j, column in enumerate(present.T):
        free = [g for g, taken in enumerate(rows) if not (taken & column).any()]
        group[j] = free[0] if free else len(rows)
        if not free:
            rows.append(np.zeros(len(column), bool))
        rows[group[j]] = rows[group[j]] | column
    return group


def _structure(jaxpr: Any, inputs: Sequence[dict[int, int]]) -> list[dict[int, int]]:
    """For each output of a linear program: the inputs that it depends on, with the kind of their entry."""
    env: dict[Any, dict[int, int]] = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(atom: Any) -> dict[int, int]:
        return {} if is_literal(atom) else env.get(atom, {})

    for equation in jaxpr.eqns:
        name, parts = equation.primitive.name, [read(atom) for atom in equation.invars]
        if name in ("jit", "pjit", "closed_call"):
            outputs = _structure(equation.params["jaxpr"].jaxpr, parts)
        else:
            inputs_once = sum(map(len, parts)) == len({j for part in parts for j in part})
            unchanged = name in ("add", "add_any") and inputs_once
            outputs = [{j: kind if unchanged else VARIABLE for part in parts for j, kind in part.items()}]
            outputs *= len(equation.outvars)
        env.update(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def covariance_of(
    mean: State, upper: AnyCovariance, quantity: Callable[[State], Iterable[Scalar]]
) -> dict[tuple[int, int], Scalar]:
    """The covariance of a quantity of one trajectory's state, linearised at the mean: its upper triangle by index.

    `upper`: covariance of the small step about `mean`, or of its leading components where the quantity is a function of
    these alone. A component of the state is selected by its name, whatever the
    order of the fields, at no cost in the compiled program.
    """
    point, rebuild = coordinates(mean)
    _, rows = linearise(lambda *x: list(quantity(rebuild(x))), point)
    entries = as_scalars(upper)
    P = full(entries, size_of(entries))
    return {
        (i, j): total(times(times(a, P[m][n]), b) for m, a in rows[i].items() for n, b in rows[j].items())
        for i, j in triangle(len(rows))
    }


def _push(jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any], fixed: Sequence[bool] = ()) -> list[Any]:
    """Evaluate a linear program; None is a structural zero, a Python float a known constant.

    `fixed`: inputs that are values at the linearisation point, not tangents (nested programs have some).
    """
    env: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, inputs, strict=True))
    fixed = fixed or [False] * len(jaxpr.invars)
    tangents = {v for v, f in zip(jaxpr.invars, fixed, strict=True) if not f}

    def read(atom: Any) -> Any:
        return atom.val if is_literal(atom) else env[atom]

    for equation in jaxpr.eqns:
        values = [read(atom) for atom in equation.invars]
        moving = [not is_literal(atom) and atom in tangents for atom in equation.invars]
        if any(moving):
            tangents.update(equation.outvars)
        if any(moving) and all(x is None for x, m in zip(values, moving, strict=True) if m):
            outputs = [None] * len(equation.outvars)
        else:
            outputs = _apply(equation, values, moving)
        env.update(zip(equation.outvars, outputs, strict=True))
    # A literal among the outputs of a linear program is a zero.
    return [None if is_literal(atom) else env[atom] for atom in jaxpr.outvars]


def _apply(equation: Any, values: list[Any], moving: list[bool]) -> list[Any]:
    """One equation of the linear program on tangents that may be structural zeros or ones."""
    name = equation.primitive.name
    if name in ("add", "add_any") and any(x is None for x in values):
        return [values[0] if values[1] is None else values[1]]
    if name == "mul":
        return [times(*values)]
    if name == "neg":
        return [-values[0]]
    if name == "sub" and values[1] is None:
        return [values[0]]
    if name == "sub" and values[0] is None:
        return [-values[1]]
    if name in ("jit", "pjit", "closed_call"):
        inner = equation.params["jaxpr"]
        return _push(inner.jaxpr, inner.consts, values, [not m for m in moving])
    arrays = [
        jnp.zeros(atom.aval.shape, atom.aval.dtype) if x is None else jnp.asarray(x, atom.aval.dtype)
        for x, atom in zip(values, equation.invars, strict=True)
    ]
    result = equation.primitive.bind(*arrays, **equation.params)
    return list(result) if equation.primitive.multiple_results else [result]
