"""Time and memory against the size of the problem: `python -m experiments.lab.bench.growth [SERIES …]`.

Every point runs in a process of its own, without a cache of compiled programs: the first call, which traces and
compiles, then medians of warm runs; memory is the peak of the process over that before the first call. Peers (extra:
peers) and plain NumPy loops run up to the sizes that they finish in seconds. Slopes are fitted to the logarithms of
processor time and size. With `--page` the tables replace those of a page. The problems are in `growth_cases.py`.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.growth_cases import SERIES, build
from experiments.lab.bench.timing import clocked, replace_tables, turns, write_json
from experiments.lab.subprocesses import in_new_process_or_failed

ROUNDS = 3
LIMIT_S = 120.0


def main(
    series: tuple[str, ...] = (),
    *,
    small: bool = False,
    page: Path | None = None,
    out: Path = Path("out/bench-growth.json"),
) -> int:
    """Measure the series, print their tables and write the results as JSON; 1 if a point of ours fails.

    Args:
        series: rows, trajectories, states, anchors, particles, tunables; by default all.
        small: only the two smallest sizes, to see that all versions run.
        page: the page whose tables are replaced, as docs/performance.md.
        out: the JSON file to write.
    """
    from experiments.lab.bench.__main__ import machine

    unknown = [name for name in series if name not in SERIES]
    if unknown:
        print(f"bench: unknown series {', '.join(unknown)}; expected {', '.join(SERIES)}", file=sys.stderr)
        return 2
    began, host = datetime.now(UTC), machine()
    results: dict[str, Any] = {}
    for name in series or SERIES:
        sizes = SERIES[name].sizes[: 2 if small else None]
        results[name] = {
            version: {str(size): point_apart(name, version, size) for size in sizes if size <= largest}
            for version, largest in SERIES[name].versions.items()
        }
    text = "\n".join(table(name, found) for name, found in results.items())
    command = ["python", "-m", "experiments.lab.bench.growth", *sys.argv[1:]]
    heading = f"{host['cpu']}, {host['cores']} cores, {began:%Y-%m-%d}, `{' '.join(command)}`.\n"
    print(f"{heading}\n{text}")
    if page is not None:
        replace_tables(page, "experiments.lab.bench.growth", f"{heading}\n{text}")
    took = (datetime.now(UTC) - began).total_seconds()
    date = began.isoformat(timespec="seconds")
    write_json(out, {"date": date, "command": command, "machine": host, "series": results, "took_s": took})
    print(f"Written: {out}; the whole took {took:.0f} s")
    return int(any("failed" in p for found in results.values() for p in found["ours"].values()))


def point_apart(series: str, version: str, size: int) -> dict[str, Any]:
    """The result of one point in a new process, or the reason of its failure."""
    return in_new_process_or_failed("experiments.lab.bench.growth", "point", (series, version, str(size)), LIMIT_S)


def point(series: str, version: str, size: str) -> dict[str, Any]:
    """The first call, warm runs and memory of one version at one size, in this process."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        os.environ.pop(name, None)
    set_flags()
    run, rows = build(series, version, int(size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (first, first_cpu), _ = clocked(run)
    seconds = np.median(turns([run], ROUNDS)[:, 0], axis=0)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "rows": rows,
        "first_s": first,
        "first_cpu_s": first_cpu,
        "warm_s": float(seconds[0]),
        "warm_cpu_s": float(seconds[1]),
        "memory_mib": (peak - before) / 1024,
    }


def table(name: str, found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """The Markdown table of a series, and its slopes."""
    lines = [
        f"### {name}: {SERIES[name].about}",
        "",
        f"| {name} | version | first call, processor s | run ms | processor ms | M rows per processor s | memory MiB |",
        "| ---: | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for version, points in found.items():
        for size, p in points.items():
            if "failed" in p:
                lines.append(f"| {size} | {version} | | | | | {p['failed'].replace('|', '/')} |")
                continue
            lines.append(
                f"| {size} | {version} | {p['first_cpu_s']:.2f} | {1e3 * p['warm_s']:.4g} | "
                f"{1e3 * p['warm_cpu_s']:.4g} | {p['rows'] / p['warm_cpu_s'] / 1e6:.3g} | {p['memory_mib']:.0f} |"
            )
    slopes = {version: slope(points) for version, points in found.items()}
    fitted = [f"{version} {value:.2f}" for version, value in slopes.items() if value is not None]
    return "\n".join([*lines, "", f"Slope of processor time: {', '.join(fitted) or 'too few sizes'}.", ""])


def slope(points: Mapping[str, Mapping[str, Any]]) -> float | None:
    """The fitted slope of the logarithm of processor time on that of size; None for fewer than two sizes."""
    good = [(float(size), p["warm_cpu_s"]) for size, p in points.items() if "failed" not in p]
    if len(good) < 2:
        return None
    x, y = np.log(np.array(good)).T
    return float(np.polyfit(x, y, 1)[0])


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.growth")
