"""Accuracy and covariances on real recordings: `python -m experiments.lab.validation.real_recordings`.

Runs every fold of `folds.FOLDS`, writes `docs/real-recordings.md` and its summary in the README, and ends with exit
code 1 where a limit is missed. No fold is judged on a recording that its calibration or tuning has seen. The recordings
are not part of this repository: TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from experiments.cli.main import run_alone
from experiments.cli.runtime import keep_programs, set_flags
from experiments.lab.bench.timing import replace_tables
from experiments.lab.subprocesses import REPOSITORY, required_recordings
from experiments.lab.validation.fold_runs import Figures, run_fold
from experiments.lab.validation.folds import FOLDS, Fold
from experiments.lab.validation.real_recordings_page import all_checks, baselines, line_of, quoted, written

PAGE = REPOSITORY / "docs" / "real-recordings.md"
QUICK_PAGE = Path("out/real-recordings.md")


def main(*, quick: bool = False, page: Path | None = None) -> int:
    """Run the folds, write the page, and return 1 where a limit is missed.

    Args:
        quick: the folds of two minutes alone; their page is out/real-recordings.md.
        page: the page to write; default docs/real-recordings.md.
    """
    set_flags()
    keep_programs()
    root = required_recordings()
    began = time.monotonic()
    figures = run([fold for fold in FOLDS if fold.quick or not quick], root)
    seconds = time.monotonic() - began
    options = " --quick" if quick else ""
    command = f"python -m experiments.lab.validation.real_recordings{options}"
    out = page or (QUICK_PAGE if quick else PAGE)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(written(figures, baselines(root / "README.md"), command, seconds), "utf-8")
    if out == PAGE:
        replace_tables(REPOSITORY / "README.md", "experiments.lab.validation.real_recordings", quoted(figures))
    missed = [check for check in all_checks(figures) if not check.met]
    print(f"Written: {out} ({seconds:.0f} s)")
    for check in missed:
        print(f"missed: {check}")
    return int(bool(missed))


def run(folds: Sequence[Fold], root: Path) -> list[Figures]:
    """The figures of the folds, each printed as soon as it is measured."""
    found = []
    for fold in folds:
        for figures in run_fold(fold, root):
            print(line_of(figures), flush=True)
            found.append(figures)
    return found


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.validation.real_recordings")
