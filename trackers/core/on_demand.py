"""Public names of a package, each imported at its first use, so that a command imports only the modules it needs.

The stub `__init__.pyi` of the package is the one list of its names: type checkers read it, and its imports map names to
modules at run time (Scientific Python's SPEC 1).
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

    No function or class may have the name of a module of the package: importing that module would replace it.
    """
    tree = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    homes = {
        name.asname or name.name: (node.module, name.name)
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module and node.module != package
        for name in node.names
    }
    (public,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))

    def get(name: str) -> Any:
        if name in homes:
            module, original = homes[name]
            member = getattr(__import__(module, fromlist=[original]), original)
        elif find_spec(f"{package}.{name}") is not None:
            member = importlib.import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}{near(name, public)}")
        setattr(sys.modules[package], name, member)
        return member

    def listed() -> list[str]:
        return sorted({*public, *(name for name in vars(sys.modules[package]) if name.startswith("__"))})

    return get, listed, public
