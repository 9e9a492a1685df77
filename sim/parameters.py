"""Parameters of worlds: their ranges, in the annotations, and the check of arguments against them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from numbers import Integral, Real
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, get_args, get_origin, get_type_hints

P = ParamSpec("P")
R = TypeVar("R")


@dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`, without `high` itself where `open`."""

    low: float
    high: float
    open: bool = False

    def contains(self, value: float) -> bool:
        """Whether the value is one of them; NaN is not."""
        return self.low <= value < self.high or (value == self.high and not self.open)

    def __str__(self) -> str:
        return f"from {self.low:g} to {'below ' if self.open else ''}{self.high:g}"


class ParameterError(ValueError):
    """An argument of a world outside its range or choices: the parameter's `name`, the `value`, what was `expected`."""

    def __init__(self, name: str, value: Any, expected: str) -> None:
        super().__init__(f"{name} = {value!r}: expected {expected}")
        self.name, self.value, self.expected = name, value, expected


def checked(world: Callable[P, R]) -> Callable[P, R]:
    """The function with its arguments checked against their annotations before the call.

    It raises TypeError for an unknown parameter, ParameterError for a value outside its range or choices.
    """
    signature = inspect.signature(world)
    hints = get_type_hints(world, include_extras=True)

    @wraps(world)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        refuse_unknown(kwargs, signature.parameters)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            _check(name, value, hints[name])
        return world(*args, **kwargs)

    return call


def refuse_unknown(names: Iterable[str], parameters: Iterable[str]) -> None:
    """Raise TypeError for the first of the names that is no parameter."""
    known = list(parameters)
    for name in names:
        if name not in known:
            raise TypeError(f"parameter '{name}' is unknown; expected one of {', '.join(known)}")


def _check(name: str, value: Any, hint: Any) -> None:
    if get_origin(hint) is Literal and value not in get_args(hint):
        raise ParameterError(name, value, f"one of {', '.join(get_args(hint))}")
    if get_origin(hint) is Annotated:
        kind, *metadata = get_args(hint)
        for allowed in (x for x in metadata if isinstance(x, Range)):
            whole = kind is int
            if (
                not isinstance(value, Integral if whole else Real)
                or isinstance(value, bool)
                or not allowed.contains(float(value))
            ):
                raise ParameterError(name, value, f"a {'whole ' if whole else ''}number {allowed}")
