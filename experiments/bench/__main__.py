"""The benchmark: the beam tracker beside a textbook version and, with `--peers`, beside other libraries.

`python -m experiments.bench` measures twice, each time in a process of its own in which all versions take turns: as
XLA comes, and with the flags that the command line sets. Other work on the machine slows all versions alike, so the
ratios mean more than the times.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.bench.processes import new_interpreter
from experiments.cli.runtime import set_flags
from experiments.reports.tables import aligned
from trackers.core.errors import UnusableInput
from trackers.recordings.atomic import atomic_write, json_text

DEFAULT, COMMAND_LINE, MEMORY = "default", "command-line", "memory"
TITLES = {DEFAULT: "default flags", COMMAND_LINE: "flags of the command line"}
PEERS = ("dynamax", "cuthbert", "filterpy")
LIMIT_S = 150.0
"""A process that takes longer hangs: two cores can deadlock in batched LAPACK calls, which textbook versions make."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the tables and write the figures as JSON; 0, or 2 where that was not possible."""
    parser = argparse.ArgumentParser(prog="python -m experiments.bench", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--peers", action="store_true", help="also dynamax, cuthbert and filterpy (extra: peers)")
    parser.add_argument("--out", type=Path, default=Path("out/bench.json"), help="where the figures go")
    parser.add_argument("--part", choices=(DEFAULT, COMMAND_LINE, MEMORY), help=argparse.SUPPRESS)
    parser.add_argument("--peer", choices=PEERS, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.part:
        print(json_text(part(options.part, options.peer)))
        return 0
    try:
        figures = measured(options.peers)
        options.out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(options.out, lambda path: path.write_text(json_text(figures), "utf-8"))
    except (UnusableInput, OSError) as problem:
        print(f"bench: {problem}", file=sys.stderr)
        return 2
    print(report(figures))
    print(f"Written: {options.out}")
    return 0


def part(name: str, peer: str | None) -> dict[str, Any]:
    """What one process measures: our versions and the textbook's, or ours and a peer."""
    if name != DEFAULT:
        set_flags()
    # jax reads its flags when it is first imported.
    from experiments.bench import measure

    figures = measure.memory() if name == MEMORY else measure.measure(peer)
    return figures | {"xla_flags": os.environ.get("XLA_FLAGS", "")}


def measured(peers: bool) -> dict[str, Any]:
    """All figures, with the machine and the time they hold for; raises UnusableInput where a process fails."""
    began, host = datetime.now(UTC), machine()
    settings = {name: in_process(name) for name in (DEFAULT, COMMAND_LINE)}
    for name, setting in settings.items():
        for peer in PEERS if peers else ():
            # A process of its own: a library that hangs must not take the others along.
            try:
                found = in_process(name, peer)
            except UnusableInput as problem:
                print(f"bench: left out: {problem}", file=sys.stderr)
                continue
            setting["versions"][peer] = found["versions"][peer] | {"beside": found["versions"]["ours"]}
            setting["packages"] |= found["packages"]
    return {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.bench", *(["--peers"] if peers else [])],
        "machine": host,
        "settings": settings,
        "memory": in_process(MEMORY),
        "took_s": (datetime.now(UTC) - began).total_seconds(),
    }


def in_process(name: str, peer: str | None = None) -> dict[str, Any]:
    """The figures of one part, measured by a new interpreter without the user's own flags."""
    print(f"measuring: {TITLES.get(name, name)}{f', {peer}' if peer else ''} …", file=sys.stderr, flush=True)
    try:
        done = new_interpreter(["experiments.bench", "--part", name, *(["--peer", peer] if peer else [])], LIMIT_S)
    except subprocess.TimeoutExpired:
        raise UnusableInput(
            f"part '{name}'{f' with {peer}' if peer else ''} took over {LIMIT_S:.0f} s; expected a minute or two; "
            "run it again: batched LAPACK calls, as textbook versions make, can deadlock"
        ) from None
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no message"]
        hint = "; the other libraries are in the extra 'peers'" if peer else ""
        raise UnusableInput(f"part '{name}' ended with status {done.returncode}: {lines[-1]}{hint}")
    return json.loads(done.stdout)


def machine() -> dict[str, Any]:
    """The processor and what it has to do besides."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "load_average": os.getloadavg(),
    }


def report(figures: Mapping[str, Any]) -> str:
    """The figures as tables for people."""
    host, lines = figures["machine"], []
    lines.append(f"{host['cpu']}, {host['cores']} cores, load {host['load_average'][0]:.1f}, {figures['date']}")
    for name, title in TITLES.items():
        setting = figures["settings"][name]
        lines += [
            "",
            f"{title}: {setting['xla_flags'] or 'none'}",
            *table(setting["versions"]),
            *gradient(setting["versions"]),
        ]
    lines += ["", *memory(figures["memory"]), f"The whole took {figures['took_s']:.0f} s."]
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
    """The gradient in units of a run."""
    v = versions["ours, gradient"]
    return [
        f"gradient of two tunables: {v['ours_is_faster_by']:.2f} × one run, {v['run_ms']:.0f} ms; compile "
        f"{versions['ours']['compile_s']:.1f} s forward, {v['compile_s']:.1f} s gradient"
    ]


def memory(figures: Mapping[str, Any]) -> list[str]:
    """Memory of the gradient for few and for many rows."""
    return [
        f"gradient of {figures['trajectories']} trajectories × {rows} rows: temporaries {size / 1024:.0f} KiB, "
        f"inputs {figures['inputs'][rows] / 2**20:.1f} MiB, peak of the process {figures['peak'][rows] / 2**20:.0f} MiB"
        for rows, size in figures["temporaries"].items()
    ]


if __name__ == "__main__":
    sys.exit(main())
