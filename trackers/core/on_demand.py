"""Python imported when it is asked for: public names of a package, and what a user's file brings as `FILE.py:NAME`.

Each public name is imported at its first use, so that a command imports only the modules it needs. The stub
`__init__.pyi` of the package is the one list of its names: type checkers read it, and its imports map names to modules
at run time (Scientific Python's SPEC 1).
"""

from __future__ import annotations

import ast
import importlib
import sys
import traceback
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from trackwright.trackers.core.errors import UnusableInput, near, one_line


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


def split_name(name: str) -> tuple[str, str]:
    """File and name of what is given as `FILE.py:NAME`; an empty file for any other text."""
    file, _, attribute = name.rpartition(":") if ":" in name else (name, "", "")
    return (file, attribute) if file.endswith(".py") else ("", "")


def from_file(name: str, what: str, kind: str, fits: Callable[[Any], bool]) -> Any:
    """The object `FILE.py:NAME` of a file that is run once, for `what`; `fits` tells those of the `kind` from others.

    Raises UnusableInput where the file is missing or fails, and for another object.
    """
    path, attribute = split_name(name)
    file = Path(path)
    if not file.is_file():
        raise UnusableInput(f"{what} {file}:{attribute}: there is no file {file}; expected FILE.py:NAME")
    try:
        module = _module(file.resolve(), f"trackwright_{what}_{file.stem}", file.stat().st_mtime_ns)
    except Exception as error:
        notebook = file.read_bytes().lstrip().startswith(b"{")
        fix = "it is a notebook: export it as a Python file" if notebook else "correct the file"
        raise UnusableInput(f"{file}: cannot be run ({fault_of(error, file)}); {fix}") from error
    target = getattr(module, attribute, None)
    if not fits(target):
        mine = ", ".join(key for key, value in vars(module).items() if fits(value)) or "none"
        wrong = f"{attribute} is no {kind}" if attribute else f"no {kind} is named"
        raise UnusableInput(f"{file}: {wrong}; the file's are: {mine}; name one as {file}:NAME")
    return target


def fault_of(error: Exception, file: Path) -> str:
    """The kind and the message of what a user's file raised, in one line, with the last line of the file on its way."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f" in line {x.lineno}" for x in frames if Path(x.filename).resolve() == file.resolve()] or [""]
    return f"{type(error).__name__}{lines[-1]}: {one_line(error)[:200] or 'no message'}"


@lru_cache(maxsize=16)
def _module(file: Path, name: str, changed: int) -> ModuleType:
    """The module of a user's file, run; one that was `changed` since is run again. It may import those beside it."""
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    spec = spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    # Dataclasses and pytrees look it up there.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
