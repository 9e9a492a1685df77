"""The numbers that a traced function computes: what its time grows with, without a clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr


def computed_numbers(program: Jaxpr) -> int:
    """The numbers that all operations of a program yield; a loop counts once per turn, once where turns are unknown."""
    total = 0
    for operation in program.eqns:
        inner = [computed_numbers(part) for part in _programs(operation.params)]
        if not inner:
            total += sum(math.prod(getattr(out.aval, "shape", ())) for out in operation.outvars)
        elif operation.primitive.name == "cond":
            total += max(inner)
        else:
            total += sum(inner) * int(operation.params.get("length", 1))
    return total


def _programs(params: dict[str, Any]) -> Iterator[Jaxpr]:
    for value in params.values():
        for one in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(one, ClosedJaxpr):
                yield one.jaxpr
            elif isinstance(one, Jaxpr):
                yield one
