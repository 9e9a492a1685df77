"""One timer, one fresh process, one writer: what every benchmark measures with, and where its results go."""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.cli.options import OPTIONS
from trackwright.experiments.cli.runtime import set_flags
from trackwright.experiments.lab.subprocesses import REPOSITORY, new_interpreter
from trackwright.experiments.text.tables import aligned, markdown
from trackwright.trackers.recordings.atomic import atomic_write, json_text

FOLDER = "trackwright.experiments.lab.bench"
PACKAGES = ("jax", "jaxlib", "numpy", "polars", "distributed", "dynamax", "cuthbert", "filterpy", "particles")
"""Packages whose versions are written down where they are installed."""

LINE = 400
"""Most characters of a result file's line that holds a whole list or row."""

Row = dict[str, Any]
"""A row of a table: values by the titles of their columns."""


def clocked(run: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    """Seconds and processor seconds of one run, and its result."""
    began, began_cpu = time.perf_counter(), time.process_time()
    result = run()
    return (time.perf_counter() - began, time.process_time() - began_cpu), result


def turns(runs: Iterable[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Seconds and processor seconds (rounds, runs, 2) of runs that each have one turn per round."""
    every = list(runs)
    return np.array([[clocked(run)[0] for run in every] for _ in range(rounds)])


def cold_and_warm(run: Callable[[], Any], rows: int, rounds: int) -> Row:
    """The first call, which traces and compiles, and medians of the others; for a fresh process.

    Memory is the process's peak over that before the first call; `rows` are those of one call.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (_, first), _ = clocked(run)
    wall, cpu = np.median(turns([run], rounds)[:, 0], axis=0).tolist()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "first call, processor s": first,
        "run ms": 1e3 * wall,
        "processor ms": 1e3 * cpu,
        "processor µs/row": 1e6 * cpu / rows,
        "M rows per processor s": rows / cpu / 1e6,
        "MiB": (peak - before) / 1024,
    }


class Version(NamedTuple):
    """A competitor: its trajectories and their rows, a run of it, and the error of its result, if that is compared."""

    trajectories: int
    rows: int
    run: Callable[[], Any]
    error: Callable[[Any], float] | None = None


def compared(versions: Mapping[str, Version], rounds: int) -> list[Row]:
    """First calls of all versions, then medians over rounds in which each has one turn.

    Ratios to the first version are taken within a round: other load slows all versions alike.
    """
    first, errors = {}, {}
    for name, one in versions.items():
        (first[name], _), result = clocked(one.run)
        errors[name] = None if one.error is None else one.error(result)
        del result
    seconds = turns((one.run for one in versions.values()), rounds)
    rates = np.array([one.trajectories * one.rows for one in versions.values()])[:, None] / seconds
    medians, faster = np.median(seconds, axis=0), np.median(rates[:, :1] / rates, axis=0)
    return [
        {
            "version": name, "trajectories": one.trajectories, "rows": one.rows, "first call s": first[name],
            "run ms": 1e3 * medians[k, 0], "processor ms": 1e3 * medians[k, 1],
            "M rows/s": np.median(rates[:, k, 0]) / 1e6, "ours × faster": faster[k, 0],
            "ours × faster, per processor s": faster[k, 1], "error": errors[name],
        }
        for k, (name, one) in enumerate(versions.items())
    ]  # fmt: skip


def apart(target: str, *arguments: Any, limit_s: float, flags: bool = True) -> Row:
    """What a function of this folder, as `growth_cases:point`, returns in a new interpreter, or why not under `failed`.

    `flags`: with those of the command line instead of XLA's own. The function's module is imported there alone, since
    the peak of a process is at least that of the one which started it.
    """
    print(f"measuring: {target} {' '.join(map(str, arguments))} …", file=sys.stderr, flush=True)
    program = f"from {FOLDER}.timing import answer; answer({target!r}, {arguments!r}, {flags})"
    try:
        done = new_interpreter(["-c", program], limit_s)
    except subprocess.TimeoutExpired:
        return {"failed": f"took over {limit_s:.0f} s; run it again on an idle machine"}
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"failed": f"ended with status {done.returncode}: {reason}"}
    found: Row = json.loads(done.stdout)
    return found


def apart_each(target: str, names: Iterable[str], small: bool, limit_s: float, flags: bool = True) -> list[Row]:
    """The rows that a function of a competitor's name returns, each competitor beside ours in a process of its own."""
    rows = []
    for name in names:
        found = apart(target, name, small, limit_s=limit_s, flags=flags)
        rows += found.get("rows", [{"version": name, **found}])
    return rows


def answer(target: str, arguments: Sequence[Any], flags: bool) -> None:
    """Print as JSON what the function returns, computed without a cache of compiled programs."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        os.environ.pop(name, None)
    if flags:
        set_flags()
    print(json_text(function_of(target)(*arguments)))


def function_of(target: str) -> Callable[..., Any]:
    """The function of a module of this folder, as `growth_cases:point`."""
    module, _, name = target.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"{FOLDER}.{module}"), name)
    return function


def timed_command(
    words: Sequence[str | Path], folder: Path, log: Path, environment: Mapping[str, str] | None = None,
    watch: Callable[[int], None] | None = None,
) -> Row:  # fmt: skip
    """Processor seconds with those of children, seconds, peak (MB) and exit code of a Python command in a process.

    `log`: the file of what it prints. `watch(pid)` is called twenty times a second while it runs.
    """
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as said:
        child = subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, stdout=said, stderr=said)
        while watch is not None and not os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            watch(child.pid)
            time.sleep(0.05)
        _, status, used = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
    cpu, peak = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6
    return {"cpu_s": cpu, "wall_s": seconds, "peak_mb": peak, "code": child.returncode}


def last_line(log: Path) -> str:
    """The last line of what a command printed."""
    return (log.read_text("utf-8", "replace").strip().splitlines() or ["no message"])[-1]


def machine() -> Row:
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


def commit(folder: Path) -> str:
    """The commit that is checked out there, `unknown` without git."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=folder, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def packages() -> dict[str, str]:
    """The versions of `PACKAGES`, of those that are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


class Table(NamedTuple):
    """Rows of one table, with a title, and a line or more below it."""

    rows: Sequence[Row]
    title: str = ""
    note: str = ""


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class Bench:
    """How a benchmark runs, and where its results go.

    Args:
        small: the smallest sizes and a single round, to see that everything runs.
        out: the JSON file to write (default: out/bench-NAME.json).
        page: the page whose tables of this benchmark are replaced, as docs/performance.md.
    """

    small: bool = False
    out: Path | None = None
    page: Path | None = None
    began: datetime = field(default_factory=lambda: datetime.now(UTC), init=False)
    host: Row = field(default_factory=machine, init=False)

    def rounds(self, count: int) -> int:
        """The number of rounds."""
        return 1 if self.small else count

    def publish(self, name: str, *tables: Table, **about: Any) -> None:
        """Write the results of a benchmark as JSON, print their tables, and replace those of the page.

        `about`: what else the JSON file has.
        """
        command = ["python", "-m", FOLDER, name, *sys.argv[1:]]
        rows = {"rows": tables[0].rows} if len(tables) == 1 else {"tables": {t.title: t.rows for t in tables}}
        out = self.out or Path("out") / f"bench-{name}.json"
        write_json(
            out,
            {
                "date": self.began.isoformat(timespec="seconds"),
                "command": command,
                "commit": commit(REPOSITORY),
                "machine": self.host,
                "packages": packages(),
                **about,
                **rows,
                "took_s": (datetime.now(UTC) - self.began).total_seconds(),
            },
        )
        heading = f"{self.host['cpu']}, {self.host['cores']} cores, {self.began:%Y-%m-%d}, `{' '.join(command)}`."
        print(f"{heading} Load {self.host['load_average'][0]:.1f}.\n")
        for table in tables:
            text = aligned(cells(table.rows), numeric(table.rows))
            print("\n".join(filter(None, [table.title, text, table.note])), end="\n\n")
        print(f"Written: {out}")
        if self.page is not None:
            parts = [
                [f"### {t.title}" if t.title else "", markdown(cells(t.rows), numeric(t.rows)).strip(), t.note]
                for t in tables
            ]
            text = "\n\n".join(filter(None, [heading, *(part for table in parts for part in table)]))
            replace_tables(self.page, f"{FOLDER} {name}", f"{text}\n")


DEFAULTS = Bench()


def shown(rows: Iterable[Row]) -> list[Row]:
    """The rows, each printed to the terminal once it is measured."""
    found = []
    for row in rows:
        found.append(row)
        print("  ".join(f"{k} {cell(v)}" for k, v in row.items() if v is not None), file=sys.stderr, flush=True)
    return found


def cell(value: Any) -> str:
    """A number or a text of a table; nothing for None."""
    if not isinstance(value, float):
        return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value).replace("|", "/")
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def cells(rows: Sequence[Row]) -> list[list[str]]:
    """The titles of the columns and the texts of the rows; a row may lack columns."""
    titles = list(dict.fromkeys(title for row in rows for title in row))
    return [titles, *([cell(row.get(title)) for title in titles] for row in rows)]


def numeric(rows: Sequence[Row]) -> list[int]:
    """The numbers of the columns that have no texts."""
    titles = cells(rows)[0]
    return [k for k, title in enumerate(titles) if not any(isinstance(row.get(title), str) for row in rows)]


def write_json(out: Path, results: Mapping[str, Any]) -> None:
    """Write the results, a row a line, creating the folder if missing."""
    out.parent.mkdir(parents=True, exist_ok=True)
    text = compact(json.loads(json_text(results)), top=True)
    atomic_write(out, lambda path: path.write_text(f"{text}\n", "utf-8"))


def compact(value: Any, indent: str = "", top: bool = False) -> str:
    """JSON in which a row has a line, and so has every other value that fits into one."""
    line, deeper = json.dumps(value, ensure_ascii=False), indent + "  "
    if not value or not isinstance(value, dict | list):
        return line
    if isinstance(value, dict):
        each = [f"{json.dumps(k, ensure_ascii=False)}: {compact(v, deeper)}" for k, v in value.items()]
    else:
        each = [compact(v, deeper) for v in value]
    rows = isinstance(value, list) and isinstance(value[0], dict)
    if not (top or rows or len(indent) + len(line) > LINE or any("\n" in part for part in each)):
        return line
    begin, end = "{}" if isinstance(value, dict) else "[]"
    return f"{begin}\n{deeper}" + f",\n{deeper}".join(each) + f"\n{indent}{end}"


def replace_tables(page: Path, name: str, text: str) -> None:
    """Replace what a page has between the marks of the tables of this name."""
    begin, end = f"<!-- tables of {name} -->", "<!-- end of the tables -->"
    before, _, rest = page.read_text("utf-8").partition(begin)
    page.write_text(f"{before}{begin}\n\n{text}\n{end}{rest.partition(end)[2]}", "utf-8")
