"""What a user's Python file brings under a name, `FILE.py:NAME`: trackers, and formats of logs."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from trackwright.trackers.core.errors import UnusableInput, one_line


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
    """The module of a user's file; one that was `changed` since is run again."""
    return run_file(file, name)


def run_file(file: Path, name: str) -> ModuleType:
    """The module of a Python file, which is run; registered as `name`, where dataclasses and pytrees look it up.

    The file may import those beside it.
    """
    folder = str(file.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
