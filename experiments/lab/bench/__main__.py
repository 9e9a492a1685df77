"""Speed of the beam tracker beside a textbook version and other libraries: `python -m experiments.lab.bench [--peers]`.

Two settings are measured, XLA's default flags and those of the command line, each in its own process, in which all
versions take turns. Other load on the machine slows all versions alike; ratios are more reliable than times.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import write_json
from experiments.lab.subprocesses import in_new_process
from experiments.text.tables import aligned
from trackers.core.errors import UnusableInput

DEFAULT, COMMAND_LINE, MEMORY = "default", "command-line", "memory"
TITLES = {DEFAULT: "default flags", COMMAND_LINE: "flags of the command line"}
PEERS = ("dynamax", "cuthbert", "filterpy")
LIMIT_S = 150.0
"""Limit of one process: batched LAPACK calls, as textbook versions make them, can deadlock on two cores."""


def main(*, peers: bool = False, out: Path = Path("out/bench.json")) -> int:
    """Measure the beam tracker, print the tables and write the results as JSON; 2 if a part fails.

    Args:
        peers: also dynamax, cuthbert and filterpy (extra: peers).
        out: the JSON file to write.
    """
    try:
        results = measured(peers)
        write_json(out, results)
    except (UnusableInput, OSError) as problem:
        print(f"bench: {problem}", file=sys.stderr)
        return 2
    print(report(results))
    print(f"Written: {out}")
    return 0


def part(name: str, peer: str | None = None) -> dict[str, Any]:
    """The results of one process: our versions and the textbook's, or ours and a peer's."""
    if name != DEFAULT:
        set_flags()
    # jax reads its flags when it is first used.
    from experiments.lab.bench import measure

    results = measure.memory() if name == MEMORY else measure.measure(peer)
    return results | {"xla_flags": os.environ.get("XLA_FLAGS", "")}


def measured(peers: bool) -> dict[str, Any]:
    """All results, with machine and time; raises UnusableInput if a process of ours fails."""
    began, host = datetime.now(UTC), machine()
    settings = {name: _part_apart(name) for name in (DEFAULT, COMMAND_LINE)}
    for name, setting in settings.items():
        for peer in PEERS if peers else ():
            try:
                found = _part_apart(name, peer)
            except UnusableInput as problem:
                print(f"bench: left out: {problem}", file=sys.stderr)
                continue
            setting["versions"][peer] = found["versions"][peer] | {"beside": found["versions"]["ours"]}
            setting["packages"] |= found["packages"]
    return {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.lab.bench", *(["--peers"] if peers else [])],
        "machine": host,
        "settings": settings,
        "memory": _part_apart(MEMORY),
        "took_s": (datetime.now(UTC) - began).total_seconds(),
    }


def _part_apart(name: str, peer: str | None = None) -> dict[str, Any]:
    return in_new_process("experiments.lab.bench.__main__", "part", (name, peer), LIMIT_S)


def machine() -> dict[str, Any]:
    """The processor and its load."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "load_average": os.getloadavg(),
    }


def report(results: Mapping[str, Any]) -> str:
    """The results as text."""
    host, lines = results["machine"], []
    lines.append(f"{host['cpu']}, {host['cores']} cores, load {host['load_average'][0]:.1f}, {results['date']}")
    for name, title in TITLES.items():
        setting = results["settings"][name]
        lines += [
            "",
            f"{title}: {setting['xla_flags'] or 'none'}",
            *table(setting["versions"]),
            *gradient(setting["versions"]),
        ]
    lines += ["", *memory(results["memory"]), f"The whole took {results['took_s']:.0f} s."]
    return "\n".join(lines)


def table(versions: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """One line per version."""
    head = ("version", "size", "compile s", "run ms", "M steps/s", "ours × faster", "… per cpu s", "error °")
    rows = [head]
    for name, v in versions.items():
        if name == "ours, gradient":
            continue
        error = "" if v["azimuth_error_deg"] is None else f"{v['azimuth_error_deg']:.3f}"
        rows.append(
            (
                name,
                f"{v['trajectories']} × {v['rows']}",
                f"{v['compile_s']:.1f}",
                f"{v['run_ms']:.1f}",
                f"{v['million_steps_per_s']:.3f}",
                f"{v['ours_is_faster_by']:.1f}",
                f"{v['ours_is_faster_by_per_cpu_second']:.1f}",
                error,
            )
        )
    return aligned(rows, range(1, len(head))).splitlines()


def gradient(versions: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Cost of the gradient in units of a run."""
    v = versions["ours, gradient"]
    return [
        f"gradient of two tunables: {v['ours_is_faster_by']:.2f} × one run, {v['run_ms']:.0f} ms; compile "
        f"{versions['ours']['compile_s']:.1f} s forward, {v['compile_s']:.1f} s gradient"
    ]


def memory(results: Mapping[str, Any]) -> list[str]:
    """Memory of the gradient for few and for many rows."""
    return [
        f"gradient of {results['trajectories']} trajectories × {rows} rows: temporaries {size / 1024:.0f} KiB, "
        f"inputs {results['inputs'][rows] / 2**20:.1f} MiB, peak of the process {results['peak'][rows] / 2**20:.0f} MiB"
        for rows, size in results["temporaries"].items()
    ]


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench")
