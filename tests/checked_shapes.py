"""Checks the shapes and types of arrays in annotations while tests run; imported before the packages that it checks."""

import inspect
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any, get_args, get_origin, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, install_import_hook

ROOT = Path(__file__).parents[1]
FILES = [path for folder in ("trackers/core", "tuning", "sim") for path in (ROOT / folder).rglob("*.py")]
ANNOTATED = [path.relative_to(ROOT).with_suffix("") for path in FILES if "jaxtyping" in path.read_text("utf-8")]

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


_whole = jaxtyping.jaxtyped
_checked = dict[CodeType, bool]()


def jaxtyped(*, typechecker: Any) -> Callable[[Any], Any]:
    """jaxtyping's decorator for classes, and functions with the shape of an array in their signature.

    Of other functions there is nothing to check, and its wrapper takes a fifth of the time of tracing.
    """
    decorate = _whole(typechecker=typechecker)

    def decorated(one: Any) -> Any:
        return decorate(one) if not inspect.isfunction(one) or _may_hold_shapes(one) else one

    return decorated


def _may_hold_shapes(function: Any) -> bool:
    # Functions within functions are decorated whenever they are made.
    if function.__code__ not in _checked:
        try:
            hints = get_type_hints(function, include_extras=True).values()
        except Exception:  # a name that is not defined yet
            hints = None
        _checked[function.__code__] = hints is None or any(map(holds_shape, hints))
    return _checked[function.__code__]


jaxtyping.jaxtyped = jaxtyped  # by this name the hook decorates
install_import_hook([".".join(["trackwright", *path.parts]) for path in ANNOTATED], "tests.checked_shapes.check_arrays")
