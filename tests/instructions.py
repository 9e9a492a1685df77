"""Instructions of five hot paths, counted by valgrind (Linux): `python -m tests.instructions`.

Exit code 1 where a path takes over a tenth more than kept, 2 where the counts kept are of other versions.

Seconds vary with the machine's other work by more than changes of the code cost; counts do not. Each path runs once to
compile, then is counted four times, and the least count stands. `--write` keeps the counts in `instructions.json`, with what
they depend on: valgrind shows programs a processor of its own, so that the versions matter, and the machine does not.
For the same reason programs are compiled here, and neither kept nor taken from the cache.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
KEPT = Path(__file__).with_suffix(".json")
MORE = 0.1  # by which share a path may take more instructions than kept

TIMES = 4  # how often a path is counted: counts of the particle filter differ by 7 % between runs of the same code


def main() -> int:
    """Count, and compare or keep; exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="keep the counts, with the versions")
    write = parser.parse_args().write
    found = {"versions": versions(), "instructions": counted()}
    if write:
        from tests.json_lines import write_json

        write_json(KEPT, found)
    kept = json.loads(KEPT.read_text("utf-8"))
    print("\n".join(lines(kept, found)))
    return 2 if kept["versions"] != found["versions"] else int(bool(grown(kept, found)))


def versions() -> dict[str, str]:
    """What counts depend on, besides the code."""
    valgrind = subprocess.check_output(["valgrind", "--version"], text=True).strip().removeprefix("valgrind-")
    libraries = {name: version(name) for name in ("jaxlib", "numpy", "polars")}
    return {"python": platform.python_version(), "valgrind": valgrind, **libraries}


def lines(kept: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """A line for each path; a first one where the counts are of other versions."""
    others = [f"{name} {then}" for name, then in kept["versions"].items() if found["versions"][name] != then]
    head = [f"the counts are kept with {', '.join(others)}; compare both commits here with --write"] if others else []
    rows = [
        f"{name:12} {count / 1e6:8.1f} million, kept {kept['instructions'][name] / 1e6:.1f}"
        f" ({count / kept['instructions'][name] - 1:+.1%})"
        for name, count in found["instructions"].items()
    ]
    return [*head, *rows]


def grown(kept: dict[str, Any], found: dict[str, Any]) -> list[str]:
    """The paths that take too many instructions more than kept."""
    return [n for n, count in found["instructions"].items() if count > (1 + MORE) * kept["instructions"][n]]


def counted() -> dict[str, int]:
    """The instructions of each path."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {
            **{name: text for name, text in os.environ.items() if name != "XLA_FLAGS"},
            "PYTHONPATH": str(ROOT),
            # Threads that wait for work count, too.
            **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS"), "1"),
        }
        options = ["--tool=callgrind", "--instr-atstart=no", f"--callgrind-out-file={folder}/counts"]
        command = ["valgrind", "-q", *options, sys.executable, "-c", "from tests.instructions import run; run()"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr[-2000:]}")
        names = done.stdout.split()
        counts: dict[str, list[int]] = {}
        for number, name in enumerate(names, 1):
            text = Path(folder, f"counts.{number}").read_text("utf-8")
            counts.setdefault(name, []).append(int(re.search(r"^totals: (\d+)", text, re.M)[1]))
    return {name: min(values) for name, values in counts.items()}


def run() -> None:
    """Run every path within valgrind, and name those counted, in order."""
    made = paths()
    for path in made.values():
        path()
    _tell_callgrind("--instr=on")
    for name, path in made.items():
        for _ in range(TIMES):
            _tell_callgrind("--zero")
            path()
            _tell_callgrind("--dump")
            print(name)


def _tell_callgrind(what: str) -> None:
    subprocess.run(["callgrind_control", what, str(os.getpid())], check=True, capture_output=True)


def paths() -> dict[str, Callable[[], object]]:
    """The five paths, each a function that runs it once: of users' waiting times the most is spent in these."""
    import trackwright as tw
    from trackwright.trackers.core.data.recording import stack
    from trackwright.tuning.objectives import NegativeLogLikelihood
    from trackwright.tuning.parameters import flatten, select_parameters
    from trackwright.tuning.problem import Problem

    folder = tw.simulate.ranges(n=4, seed=3, rows=200).folder()
    uwb = tw.build("uwb", folder)
    tw.write(folder, "hall")
    estimates = uwb.run(folder)

    tracker = tw.uwb_imu.range_tracker(4)
    parameters = select_parameters(tracker, ("motion.sigma_a", "sensors.ranges.sigma_r"))
    problem = Problem(
        tracker,
        [stack(tw.simulate.ranges(n=64, seed=4, rows=200).recordings("uwb"))],
        NegativeLogLikelihood(),
        parameters,
    )

    vehicles = tw.simulate.agv(n=16, seed=3, rows=400).folder()
    smoother = tw.build("fix-kf", vehicles).smoothing()
    line = tw.simulate.line(n=2, seed=3).folder()
    particles = tw.build("line-pf", line)
    return {
        "filter": lambda: uwb.run(folder),
        "gradient": lambda: problem.evaluate(flatten(parameters)),
        "smoother": lambda: smoother.run(vehicles),
        "particles": lambda: particles.run(line),
        "evaluate": lambda: tw.evaluate(estimates, tw.read("hall")),
    }


if __name__ == "__main__":
    sys.exit(main())
