"""The laboratory: `python -m trackwright.experiments.lab TABLE` measures a table; without a name, the list of them."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from trackwright.experiments.cli.console import keep_programs
from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.runner import EVIDENCE, measure
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput, near

LAB = "trackwright.experiments.lab"
TABLES = {
    "real-recordings": "validation.real_recordings",
    "levels": "validation.levels",
    "nis": "validation.nis",
    "own-levels": "validation.own_levels",
    "generalisation": "validation.generalisation",
    "programs": "bench.programs",
    "commands": "bench.commands",
    "studies": "bench.studies",
    "gpu": "bench.programs:gpu_cases",
}
"""The module of each table, and the function that lists the cases, if it is not called `cases`."""


def lab(table: str = "", /, *, only: str = "", out: Path | None = None) -> int:
    """Measure the rows that a table lacks, and those with an error; delete the file to measure all of them anew.

    Returns 1 if a row has an error.

    Args:
        table: its name; without one, all are listed.
        only: a part of the names of cases, or a pattern as `ngbui-* / uwb / *`; the others keep their rows.
        out: the CSV file (default: docs/evidence/TABLE.csv).
    """
    if not table:
        for name, target in TABLES.items():
            module, _ = _target(target)
            print(f"{name:18s}{(module.__doc__ or '').splitlines()[0]}")
        return 0
    if table not in TABLES:
        raise UnusableInput(f"table {table}: unknown{near(table, TABLES)}; expected one of {', '.join(TABLES)}")
    module, function = _target(TABLES[table])
    if ".bench." not in module.__name__:  # A benchmark measures compiling, too.
        keep_programs()
    file = out or EVIDENCE / f"{table}.csv"
    failed = measure(getattr(module, function)(), file, only, notice)
    print(f"Written: {file}" + f"; {failed} rows have an error" * bool(failed))
    return int(bool(failed))


def _target(target: str) -> tuple[ModuleType, str]:
    """The module and the name of the function of a table."""
    module, _, function = target.partition(":")
    return import_module(f"{LAB}.{module}"), function or "cases"


if __name__ == "__main__":
    run_alone(lab, f"python -m {LAB}")
