"""The laboratory: `python -m trackwright.experiments.lab TABLE` measures a table; without a name, the list of them."""

from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path

from trackwright.experiments.cli.console import keep_programs
from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.runner import EVIDENCE, Case, measure
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput, near

LAB = "trackwright.experiments.lab"
TABLES = {
    "real-recordings": "validation.real_recordings:cases",
    "generalisation": "validation.real_recordings:generalisation_cases",
    "levels": "validation.levels:cases",
    "programs": "validation.speed:program_cases",
    "commands": "validation.speed:command_cases",
    "studies": "validation.speed:study_cases",
    "gpu": "validation.speed:gpu_cases",
}
"""The function that lists the cases of each table."""


def lab(table: str = "", /, *, only: str = "", out: Path | None = None) -> int:
    """Measure the rows that a table lacks, and those with an error; delete the file to measure all of them anew.

    Returns 1 if a row has an error.

    Args:
        table: its name; without one, all are listed.
        only: a part of the names of cases, or a pattern as `ngbui-* / uwb / *`; the others keep their rows.
        out: the CSV file (default: docs/evidence/TABLE.csv).
    """
    if not table:
        for name in TABLES:
            print(f"{name:18s}{(_cases_of(name).__doc__ or '').splitlines()[0]}")
        return 0
    if table not in TABLES:
        raise UnusableInput(f"table {table}: unknown{near(table, TABLES)}; expected one of {', '.join(TABLES)}")
    if not TABLES[table].startswith("validation.speed"):  # A benchmark measures compiling, too.
        keep_programs()
    file = out or EVIDENCE / f"{table}.csv"
    failed = measure(_cases_of(table)(), file, only, notice)
    print(f"Written: {file}" + f"; {failed} rows have an error" * bool(failed))
    return int(bool(failed))


def _cases_of(table: str) -> Callable[[], Iterable[Case]]:
    """The function that lists the cases of a table."""
    module, _, function = TABLES[table].partition(":")
    cases: Callable[[], Iterable[Case]] = getattr(import_module(f"{LAB}.{module}"), function)
    return cases


if __name__ == "__main__":
    run_alone(lab, f"python -m {LAB}")
