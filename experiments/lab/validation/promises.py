"""The promises of docs/promises.md, each with the command that proves it, run in its quick form."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time
from datetime import date
from pathlib import Path
from typing import NamedTuple

from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.subprocesses import REPOSITORY

TESTS = "python -m pytest -o addopts= --import-mode=importlib -q"
CHUNKS = "tests/experiments/monte_carlo/test_chunk_store.py"
FITS = "tests/tuning/test_fitting.py"
CONTINUED = "tests/test_continued_runs.py tests/test_identities.py"


class Promise(NamedTuple):
    """What is promised, and the command that ends with exit code 0 where it is kept."""

    words: str
    command: str


PROMISES = {
    "threads": Promise(
        "the same bits for any number of threads, chunks and devices",
        f"{TESTS} tests/experiments/monte_carlo/test_study.py tests/sim/test_stations.py -k 'two_devices or no_bit'",
    ),
    "cluster": Promise(
        "the same bits on a cluster",
        f"{TESTS} tests/experiments/monte_carlo/test_portable.py tests/tuning/test_parts.py -k bits",
    ),
    "resumed": Promise(
        "the same bits after an interruption: of a study, a fit, a track",
        f"{TESTS} {CHUNKS} {FITS} {CONTINUED} -k 'same_bits or resumed or fix-kf-cut or one_row_at_a_time and fix-kf'",
    ),
    "releases": Promise("the same bits in later releases, for seven subjects", "python -m tests.released"),
    "gradients": Promise("gradients are those of independent oracles", "python -m trackwright.experiments verify"),
    "mutations": Promise("a small mistake in the code fails a test", "python -m tests.mutation --again"),
    "inputs": Promise(
        "no traceback, whatever a recording holds", "python -m tests.faults check --count 200 --seed 101"
    ),
    "logs": Promise("nor a log of another program", "python -m tests.faults import --count 50 --seed 101"),
    "refused": Promise(
        "what readings do not determine is refused or marked, not guessed",
        f"{TESTS} {FITS} tests/tuning/test_uncertainty.py tests/tuning/test_survey.py tests/trackers/fusion "
        "-k 'undetermined or no_interval or refuses or cannot_support or no_start'",
    ),
    "coverage": Promise(
        "ellipses hold on a third of the public recordings, at levels that their sites have not set",
        "python -m trackwright.experiments.lab.validation real-recordings --at-least 0.33",
    ),
    "speed": Promise("no hot path takes a tenth more instructions", "python -m tests.instructions"),
}


def promises(*names: str, output: Output = DEFAULTS) -> int:
    """Every promise and whether it is kept here; exit code 1 where one is not.

    Args:
        names: some promises, whose rows replace those of the result file; all by default.
    """
    out = output.out or Path("out/validation-promises.json")
    found = shown(map(kept, chosen(names, PROMISES)))
    before = json.loads(out.read_text("utf-8"))["rows"] if out.exists() else []
    rows = {row["promise"]: row for row in (*before, *found)}
    shown_rows = [rows[p.words] for p in PROMISES.values() if p.words in rows]
    output.publish("validation promises", Table(shown_rows))
    return int(any(row["kept"] == "no" for row in shown_rows))


def kept(name: str) -> Row:
    """The row of a promise: its command, the last line that it printed, and how long it took."""
    promise, began = PROMISES[name], time.monotonic()
    line = [sys.executable, *shlex.split(promise.command)[1:]]
    done = subprocess.run(line, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    said = (done.stdout.strip() or done.stderr.strip() or "nothing").splitlines()[-1]
    # Exit code 2: what the command compares with is of another machine, or not there.
    verdict = {0: "yes", 2: "not judged here"}.get(done.returncode, "no")
    return {
        "promise": promise.words, "command": f"`{promise.command}`", "said": said,
        "kept": verdict, "on": f"{date.today()}", "s": round(time.monotonic() - began),
    }  # fmt: skip
