"""One command in this process, with its processor time split by what it was spent on.

Run as a script, `python waiting_split.py SPLIT.json ARGUMENTS …`, in the folder of any checkout, whose command line it
runs. It imports nothing of ours before the command does, since imports are part of what is measured.
"""

from __future__ import annotations

import atexit
import builtins
import json
import sys
import time
from collections import defaultdict
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

TIMERS = "jax._src.dispatch"
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


def measure(split: Split, module: Any) -> None:
    """Puts the time within functions of a module, or within jax's own timers, down to their phase."""
    for function, phase in FUNCTIONS.get(module.__name__, {}).items():
        setattr(module, function, measured(split, getattr(module, function), phase))
    if module.__name__ != TIMERS:
        return
    timer = module.LogElapsedTimeContextManager
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
    split, depth, load, pending = Split(), 0, builtins.__import__, {*FUNCTIONS, TIMERS}

    def load_measured(*names: Any, **options: Any) -> ModuleType:
        nonlocal depth
        depth += 1
        if depth == 1:
            split.enter("imports")
        try:
            imported = load(*names, **options)
            # Before a statement `from module import function` takes it out of the module.
            for name in pending & sys.modules.keys():
                if not sys.modules[name].__spec__._initializing:  # type: ignore[union-attr]
                    pending.remove(name)
                    measure(split, sys.modules[name])
            return imported
        finally:
            depth -= 1
            if depth == 0:
                split.leave()

    def write() -> None:
        split.switch()
        out.write_text(json.dumps(split.seconds), "utf-8")

    atexit.register(write)
    builtins.__import__ = load_measured
    sys.path[0], sys.argv = ".", ["trackwright", *arguments]
    from trackwright.experiments.cli.main import main

    main()


if __name__ == "__main__":
    main()
