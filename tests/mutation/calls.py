"""A pytest plugin that records which functions of the product each test file calls, and how long it runs.

Each process writes a file of its own into the folder `$MUTATION_CALLS`. What was compiled for one file is forgotten
before the next, which would otherwise not trace, and so not call, what it tests.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import pytest

ROOT = Path(__file__).parents[2]
PRODUCT = str(ROOT / "trackwright")
"""The folder of links by which the product is imported."""

FOLDER = "MUTATION_CALLS"
AT_IMPORT = ""

_called: dict[str, set[tuple[str, int]]] = {AT_IMPORT: set()}
_seconds: dict[str, float] = {}
_now = _called[AT_IMPORT]


def _note(frame: FrameType, event: str, _: Any) -> None:
    if event == "call" and frame.f_code.co_filename.startswith(PRODUCT):
        _now.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))


def pytest_load_initial_conftests() -> None:
    """Begins before the product is imported."""
    threading.setprofile(_note)
    sys.setprofile(_note)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[Any]:
    """Notes calls under the test's file."""
    global _now
    file = item.path.relative_to(ROOT).as_posix()
    if file not in _called:
        jax.clear_caches()
        _called[file] = set()
    _now = _called[file]
    begin = time.monotonic()
    sys.setprofile(_note)
    try:
        return (yield)
    finally:
        _seconds[file] = _seconds.get(file, 0.0) + time.monotonic() - begin


def pytest_sessionfinish() -> None:
    """Writes what was noted."""
    sys.setprofile(None)
    threading.setprofile(None)
    if FOLDER in os.environ:
        calls = {file: sorted((name[len(PRODUCT) + 1 :], line) for name, line in of) for file, of in _called.items()}
        content = {"calls": calls, "seconds": _seconds}
        (Path(os.environ[FOLDER]) / f"{os.getpid()}.json").write_text(json.dumps(content), "utf-8")
