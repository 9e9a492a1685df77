"""Measurements as cases: each is one row of a CSV, and a run goes on where the last one stopped; fresh processes."""

from __future__ import annotations

import csv
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from fnmatch import fnmatch
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

from trackwright.trackers.core.errors import UnusableInput

REPOSITORY = Path(__file__).resolve().parents[2]  # the checkout: the folder `trackwright` in it holds links

EVIDENCE = REPOSITORY / "docs" / "evidence"  # where the tables are that pages quote

KEY = ("recording", "tracker", "setting", "seed")
"""The first columns of every table, which name a case; the last is `error`."""

Figures = Mapping[str, Any]
"""What a case measures, by column: numbers, texts, and None for a figure that it does not have."""


class Case(NamedTuple):
    """One row: a recording or a world, a tracker, how it is run, the seed, and the function that measures."""

    recording: str
    tracker: str
    setting: str
    measure: Callable[[], Figures]
    seed: int = 0

    @property
    def key(self) -> tuple[str, ...]:
        """The texts of the columns that name the case."""
        return (self.recording, self.tracker, self.setting, str(self.seed))

    @property
    def name(self) -> str:
        """The key as one text, which `--only` matches."""
        return " / ".join(self.key if self.seed else self.key[:3])


def measure(
    cases: Iterable[Case], file: Path, only: str = "", report: Callable[[str], None] = lambda text: None
) -> int:
    """Measure the cases that have no row in the file yet, or one with an error; returns how many of the chosen failed.

    The file is replaced after each case, its rows in the order of the cases; rows that no case names any more go.
    `only`: a part of names, or a pattern; rows of other cases stay as they are. `report` gets a line for each case.
    Raises UnusableInput for two cases of one name, and where none is chosen.
    """
    cases = list(cases)
    names = [case.name for case in cases]
    for name in names:
        if names.count(name) > 1:
            raise UnusableInput(f"{file.name}: {names.count(name)} cases are called {name}; expected one")
    chosen = [case for case in cases if fnmatch(case.name, f"*{only}*")]
    if not chosen:
        raise UnusableInput(f"--only {only}: no case matches; the first are {'; '.join(names[:5])}")
    rows = {tuple(row[column] for column in KEY): row for row in read(file)} if file.exists() else {}
    for number, case in enumerate(chosen, 1):
        if case.key in rows and not rows[case.key]["error"]:
            continue
        rows[case.key] = _row(case)
        shown = "  ".join(f"{k} {v}" for k, v in rows[case.key].items() if v and k not in KEY)
        report(f"{number} of {len(chosen)}: {case.name}: {shown}")
        write(file, [rows[one.key] for one in cases if one.key in rows])
    if gone := rows.keys() - {case.key for case in cases}:
        report(f"{file.name}: {len(gone)} rows are of no case any more and were left out")
        write(file, [rows[one.key] for one in cases if one.key in rows])
    return sum(bool(rows[case.key]["error"]) for case in chosen)


def _row(case: Case) -> dict[str, str]:
    """The texts of a row by column; of a case that fails, the error alone."""
    try:
        figures, error = case.measure(), ""
    except Exception as problem:  # One failing case must not stop the others.
        figures, error = {}, " ".join(f"{type(problem).__name__}: {problem}".split())
    return {**dict(zip(KEY, case.key, strict=True)), **{k: text(v) for k, v in figures.items()}, "error": error}


def text(value: Any) -> str:
    """The cell of a value: floats with six significant digits, nothing for None and NaN."""
    if value is None or value != value:
        return ""
    return f"{value:.6g}" if isinstance(value, Real) and not isinstance(value, Integral) else str(value)


def write(file: Path, rows: Sequence[Mapping[str, str]]) -> Path:
    """Write a table; a row may lack columns."""
    # It takes a quarter of a second to import, which the help of `demo` need not wait for.
    import polars as pl

    from trackwright.trackers.recordings.files import atomic_write

    columns = list(dict.fromkeys([*KEY, *(name for row in rows for name in row if name != "error"), "error"]))
    table = pl.DataFrame(rows, dict.fromkeys(columns, pl.String)).with_columns(pl.all().replace("", None))
    file.parent.mkdir(parents=True, exist_ok=True)
    return atomic_write(file, table.write_csv)


def read(file: Path) -> list[dict[str, str]]:
    """The rows of a table."""
    with file.open(encoding="utf-8", newline="") as opened:
        return list(csv.DictReader(opened))


@cache
def machine() -> dict[str, str]:
    """The columns of a table of times: processor, cores and commit."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text("utf-8").splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    return {
        "machine": f"{models[0] if models else platform.processor()}, {os.cpu_count()} cores",
        "commit": git.stdout.strip() or "unknown",
    }


def recordings_folder() -> Path | None:
    """The folder of real recordings: TRACKWRIGHT_RECORDINGS, else `../shared/recordings` beside the repository."""
    folder = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", REPOSITORY.parent / "shared" / "recordings"))
    return folder if folder.is_dir() else None


def required_recordings() -> Path:
    """The folder of real recordings; raises UnusableInput where there is none."""
    folder = recordings_folder()
    if folder is None:
        raise UnusableInput(
            "no folder of real recordings; expected ../shared/recordings or a folder named by TRACKWRIGHT_RECORDINGS"
        )
    return folder


def command(*arguments: str | Path) -> None:
    """Print a `trackwright` command and run it, its output to the terminal; exits with its code if it fails."""
    print(f"\n$ trackwright {shlex.join(map(str, arguments))}", flush=True)
    line = [sys.executable, "-m", "trackwright", *map(str, arguments)]
    if code := subprocess.run(line, check=False).returncode:
        sys.exit(code)


def new_interpreter(arguments: Sequence[str], limit_s: float) -> None:
    """Run Python with these arguments, without the user's XLA flags.

    Raises RuntimeError with the last line of its errors if it fails, and TimeoutExpired after `limit_s`.
    """
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    line = [sys.executable, *arguments]
    done = subprocess.run(line, env=environment, capture_output=True, text=True, timeout=limit_s, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
