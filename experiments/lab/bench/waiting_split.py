"""One command in this process, with its processor time split by what it was spent on.

Run as a script, `python waiting_split.py SPLIT.json ARGUMENTS …`, in the folder of any checkout, whose command line it
runs. It imports nothing of ours before the command does, since imports are part of what is measured.
"""

from __future__ import annotations

import atexit
import builtins
import importlib.abc
import json
import sys
import time
from collections import defaultdict
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

FUNCTIONS = {
    "trackwright.trackers.recordings.folder": {"read_recordings": "reading", "read_recording": "reading"},
    "trackwright.trackers.evaluation.association": {"associate_truth": "evaluation"},
    "trackwright.trackers.evaluation.evaluate": {"evaluate": "evaluation"},
    "trackwright.trackers.evaluation.bounds": {"bounds_of": "evaluation"},
    "trackwright.experiments.pages.charts.figures": {"plot_tracks": "figures"},
    "trackwright.experiments.pages.reports.track": {"run_data": "figures", "write_track_page": "figures"},
    "trackwright.experiments.pages.charts.tuning": {"tuning_trace": "figures"},
    "trackwright.experiments.pages.reports.tuning_data": {"collect": "evaluation"},
    "trackwright.experiments.pages.reports.tuning": {"write_tuning_report": "figures"},
}
"""What is measured around functions, by module."""

EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "tracing",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
"""What jax's own timers measure; the third includes reading a compiled program from a cache."""


class Split:
    """Processor seconds by phase: a phase's own, without those of the phases within it."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.open = ["running"]
        self.since = 0.0

    def switch(self) -> None:
        now = time.process_time()
        self.seconds[self.open[-1]] += now - self.since
        self.since = now

    def enter(self, phase: str) -> None:
        self.switch()
        self.open.append(phase)

    def leave(self) -> None:
        self.switch()
        self.open.pop()


def measured(split: Split, function: Any, phase: str) -> Any:
    """The function, with its time put down to the phase."""

    def run(*arguments: Any, **options: Any) -> Any:
        split.enter(phase)
        try:
            return function(*arguments, **options)
        finally:
            split.leave()

    return run


class Measuring(importlib.abc.MetaPathFinder):
    """Measures functions of modules once these are imported."""

    def __init__(self, split: Split) -> None:
        self.split = split

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        """The module's own specification, with a loader that measures; None for modules that hold nothing measured."""
        if name not in FUNCTIONS and name != "jax._src.dispatch":
            return None
        spec = PathFinder.find_spec(name, path, target)
        assert spec is not None
        assert spec.loader is not None
        load = spec.loader.exec_module

        def load_measured(module: ModuleType) -> None:
            load(module)
            for function, phase in FUNCTIONS.get(name, {}).items():
                setattr(module, function, measured(self.split, getattr(module, function), phase))
            if name == "jax._src.dispatch":
                measure_events(self.split, module)

        spec.loader.exec_module = load_measured  # type: ignore[method-assign]
        return spec


def measure_events(split: Split, dispatch: Any) -> None:
    """Puts the time within jax's own timers down to their phase."""
    timer = dispatch.LogElapsedTimeContextManager
    enter, leave = timer.__enter__, timer.__exit__

    def entered(self: Any) -> Any:
        if self.event in EVENTS:
            split.enter(EVENTS[self.event])
        return enter(self)

    def left(self: Any, *error: Any) -> None:
        leave(self, *error)
        if self.event in EVENTS:
            split.leave()

    timer.__enter__, timer.__exit__ = entered, left


def main() -> None:
    """Runs `trackwright ARGUMENTS`; writes its split at exit, whatever its exit code."""
    out, arguments = Path(sys.argv[1]).resolve(), sys.argv[2:]
    split, depth, load = Split(), 0, builtins.__import__

    def load_measured(*names: Any, **options: Any) -> ModuleType:
        nonlocal depth
        depth += 1
        if depth == 1:
            split.enter("imports")
        try:
            return load(*names, **options)
        finally:
            depth -= 1
            if depth == 0:
                split.leave()

    def write() -> None:
        split.switch()
        out.write_text(json.dumps(split.seconds), "utf-8")

    atexit.register(write)
    builtins.__import__ = load_measured
    sys.meta_path.insert(0, Measuring(split))
    sys.path[0], sys.argv = ".", ["trackwright", *arguments]
    from trackwright.experiments.cli.main import main

    main()


if __name__ == "__main__":
    main()
