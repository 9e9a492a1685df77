"""The benchmarks: `python -m trackwright.experiments.lab.bench NAME [options]`; without a name, the table of them."""

from __future__ import annotations

import sys

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.bench.timing import FOLDER, function_of

CASES = {
    "beam": "beam:beam",
    "particles": "particles:particles",
    "tuning": "tuning:tuning",
    "growth": "growth:growth",
    "lanes": "growth:lanes",
    "bearings": "growth:bearings",
    "inertial": "growth:inertial",
    "recordings": "recordings:recordings",
    "studies": "studies:studies",
    "waiting": "waiting:waiting",
    "archives": "archives:archives",
    "cluster": "cluster:cluster",
    "cluster-fit": "cluster:cluster_fit",
    "cluster-scale": "cluster_scale:cluster_scale",
    "cluster-plan": "cluster_scale:cluster_plan",
    "gpu": "gpu:gpu",
}
"""The function of each benchmark by its name: typed options, among them those of `timing.Bench`."""


def main() -> None:
    """Run the benchmark that is named, or print all names; exits with its code, or 2."""
    name = sys.argv.pop(1) if len(sys.argv) > 1 else "--help"
    if name in CASES:
        run_alone(function_of(CASES[name]), f"python -m {FOLDER} {name}")
    if name not in ("--help", "-h"):
        print(f"bench: no benchmark {name}; expected {', '.join(CASES)}", file=sys.stderr)
        sys.exit(2)
    for each, target in CASES.items():
        print(f"{each:15s}{(function_of(target).__doc__ or '').splitlines()[0]}")


if __name__ == "__main__":
    main()
