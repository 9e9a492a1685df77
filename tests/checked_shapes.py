"""Checks the shapes and types of arrays in annotations while tests run; imported before the packages that it checks."""

from collections.abc import Callable
from typing import Any, get_args, get_origin

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, install_import_hook

PACKAGES = ["trackwright.trackers.core", "trackwright.tuning", "trackwright.sim"]

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def check_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a check of each annotation that holds an array's shape.

    mypy checks the others; at run time they would forbid tests of invalid arguments.
    """
    hints = {name: hint if holds_shape(hint) else Any for name, hint in function.__annotations__.items()}
    function.__annotations__ = hints
    return _beartype(function) if any(hint is not Any for hint in hints.values()) else function


def holds_shape(hint: Any) -> bool:
    """Whether an annotation, or a part of it, is an array type of jaxtyping."""
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return True
    # A function is no value of the types that it takes and returns.
    return get_origin(hint) is not Callable and any(holds_shape(part) for part in get_args(hint))


install_import_hook(PACKAGES, "tests.checked_shapes.check_arrays")
