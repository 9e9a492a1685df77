"""Public names of a package that are imported when they are first used, so that a command imports what it needs.

The stub `__init__.pyi` of the package is the one list of its names: type checkers read it as it is, and at run time its
imports say which module holds a name (Scientific Python's SPEC 1).
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from trackwright.trackers.core.errors import near


def names_on_demand(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of the package whose `__init__.py` is `file`; names may stand for modules.

    No function or class may have the name of a module of the package, which an import would set in its place.
    """
    tree = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    homes = {
        name.asname or name.name: (node.module, name.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module is not None
        for name in node.names
    }
    (public,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))

    def get(name: str) -> Any:
        if name in homes:
            module, original = homes[name]
            inside = find_spec(f"{module}.{original}") if hasattr(importlib.import_module(module), "__path__") else None
            found = importlib.import_module(inside.name) if inside else getattr(sys.modules[module], original)
        elif find_spec(f"{package}.{name}") is not None:
            found = importlib.import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{near(name, public)}")
        setattr(sys.modules[package], name, found)
        return found

    def listed() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return get, listed, public
