"""The cases of a folder of the laboratory: run by name, with shared options, their results in a file and on a page."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from cyclopts import Parameter

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.options import OPTIONS
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.experiments.text.tables import aligned, markdown, replace_tables, require_page
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write, json_text

LAB = "trackwright.experiments.lab"
PACKAGES = (
    "trackwright", "jax", "jaxlib", "numpy", "polars", "distributed", "dynamax", "cuthbert", "filterpy", "particles",
    "gtsam", "stonesoup",
)  # fmt: skip
"""Packages whose versions are written down where they are installed."""

LINE = 1000
"""Most characters of a result file's line that holds a whole list or row."""

NUMBER = re.compile(r"(\*\*)?[-+−–]?\d|$")
"""How the cell of a column of numbers begins, bold or not."""

MARK = "\N{WORD JOINER}"
"""Stands for Markdown's mark of bold while columns are aligned; it has no width."""

Row = dict[str, Any]
"""A row of a table: values by the titles of their columns."""


def run_case(folder: str, cases: Sequence[str]) -> None:
    """Run the case that the command line names, or print all of them; exits with its code, or 2.

    `folder`: of the laboratory, as `bench`. `cases`: module and function of each, as `cluster:cluster_fit`, which the
    command line calls `cluster-fit`; the module alone where both have one name. Its options are typed arguments, among
    them those of `Output`.
    """
    functions = {case.rpartition(":")[2].replace("_", "-"): f"{folder}.{case}" for case in cases}
    name = sys.argv.pop(1) if len(sys.argv) > 1 else "--help"
    if name in functions:
        run_alone(function_of(functions[name]), f"python -m {LAB}.{folder} {name}")
    if name not in ("--help", "-h"):
        print(f"{folder}: no case {name}; expected {', '.join(functions)}", file=sys.stderr)
        sys.exit(2)
    for each, target in functions.items():
        print(f"{each:22s}{(function_of(target).__doc__ or '').splitlines()[0]}")


def function_of(target: str) -> Callable[..., Any]:
    """The function of a module of the laboratory, as `bench.growth:point`; the one of the module's name without any."""
    module, _, name = target.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"{LAB}.{module}"), name or module.rpartition(".")[2])
    return function


def chosen(names: Sequence[str], known: Iterable[str], usual: Iterable[str] = ()) -> tuple[str, ...]:
    """The names, the `usual` or all known ones where there is none; raises UnusableInput for one that is unknown."""
    all_names = tuple(known)
    for name in names:
        if name not in all_names:
            raise UnusableInput(f"'{name}': unknown; expected some of {', '.join(all_names)}")
    return tuple(names) or tuple(usual) or all_names


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
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


class Table(NamedTuple):
    """Rows of one table, with a title, and a line or more below it."""

    rows: Sequence[Row]
    title: str = ""
    note: str = ""


@OPTIONS
@dataclass(frozen=True, kw_only=True)
class Output:
    """How much a case computes, and where its results go.

    Args:
        small: the smallest sizes and a single round, to see that everything runs.
        out: the JSON file to write (default: out/FOLDER-NAME.json).
        page: the page whose tables of this case are replaced, as docs/performance.md.
    """

    small: bool = False
    out: Path | None = None
    page: Path | None = None
    began: Annotated[datetime, Parameter(parse=False)] = field(default_factory=lambda: datetime.now(UTC), init=False)
    host: Annotated[Row, Parameter(parse=False)] = field(default_factory=machine, init=False)

    def __post_init__(self) -> None:
        if self.page is not None:
            require_page(self.page)

    def rounds(self, count: int) -> int:
        """The number of rounds."""
        return 1 if self.small else count

    def publish(self, name: str, *tables: Table, **about: Any) -> None:
        """Write the results of a case as JSON, print their tables, and replace those of the page.

        `name`: folder and case, as `bench growth`. `about`: what else the JSON file has.
        """
        command = ["python", "-m", *f"{LAB}.{name}".split(), *sys.argv[1:]]
        rows = {"rows": tables[0].rows} if len(tables) == 1 else {"tables": {t.title: t.rows for t in tables}}
        out = self.out or Path("out") / f"{name.replace(' ', '-')}.json"
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
            print(as_text(table), end="\n\n")
        print(f"Written: {out}")
        if self.page is not None:
            replace_tables(self.page, f"{LAB}.{name}", as_page(heading, tables))


def as_text(table: Table) -> str:
    """A table with its title and its note, for a terminal, which has bold as a page has; a pipe has none."""
    marked = [[text.replace("**", MARK) for text in row] for row in cells(table.rows)]
    lines = filter(None, [table.title, aligned(marked, numeric(table.rows)), table.note])
    bold = "\x1b[1m\\1\x1b[0m" if sys.stdout.isatty() else r"\1"
    return re.sub(f"{MARK}(.*?){MARK}", bold, "\n".join(lines).replace("**", MARK))


def as_page(heading: str, tables: Sequence[Table]) -> str:
    """The Markdown of tables below a heading, for `replace_tables`."""
    parts = [
        [f"### {t.title}" if t.title else "", markdown(cells(t.rows), numeric(t.rows)).strip(), t.note] for t in tables
    ]
    return "\n\n".join(filter(None, [heading, *(part for table in parts for part in table)])) + "\n"


DEFAULTS = Output()


def shown(rows: Iterable[Row]) -> list[Row]:
    """The rows, each printed to the terminal once it is measured."""
    printed = []
    for row in rows:
        printed.append(row)
        print("  ".join(f"{k} {cell(v)}" for k, v in row.items() if v is not None), file=sys.stderr, flush=True)
    return printed


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
    """The columns of numbers, as they are or as text."""
    return [k for k, column in enumerate(zip(*cells(rows)[1:], strict=True)) if all(map(NUMBER.match, column))]


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
