"""`python -m tests.mutation`: mutate single lines of the library and see whether a test fails.

Each mutation is made in a copy of the working tree. The default suite runs once without any, to record which test files call
which functions; then each mutation is tested by the files that call its function, until the first failure. The table is
printed, and written to `tests/mutation/results.json` with the command and the commit.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from tests.mutation.calls import FOLDER
from tests.mutation.operators import Mutation
from tests.mutation.selection import ROOT, Calls, concerned, declared_equivalent, drawn, found_again, reason_of
from trackwright.experiments.lab.cases import write_json

RESULTS = Path(__file__).parent / "results.json"
TIMED_OUT = ("timed out", "")
DEFAULT_RECORDINGS = ROOT.parent / "shared" / "recordings"


@dataclass(frozen=True)
class Outcome:
    """`result`: "killed", "survived", "equivalent" or "timed out"; `by`: the test that failed, or the reason.

    `error`: the exception that the test ended with, an AssertionError where a figure was wrong. `commit`: of the tree
    that was tested, with the changes that were not yet committed.
    """

    number: int
    file: str
    line: int
    kind: str
    before: str
    after: str
    result: str
    by: str
    error: str
    seconds: float
    commit: str

    @classmethod
    def of(cls, number: int, mutation: Mutation, result: str, by: str, error: str, seconds: float) -> Outcome:
        """The outcome of a mutation of the present commit."""
        m = mutation
        shown = m.before.strip(), m.after.strip()
        return cls(number, m.file, m.line, m.kind, *shown, result, by, error, round(seconds, 1), _commit())


class Scratch:
    """A copy of the working tree in which one file at a time is mutated."""

    def __init__(self, folder: Path):
        self.folder, self.passing, self.failing = folder, set[str](), set[str]()
        self.writes = int(time.time())
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True, text=True
        )
        for name in listed.stdout.splitlines():
            if (ROOT / name).exists():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                # The links of `trackwright` stay links, to the folders of the copy.
                shutil.copyfile(ROOT / name, folder / name, follow_symlinks=False)
        cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", f"{tempfile.gettempdir()}/trackwright-mutation-cache")
        self.environment = {
            **os.environ,
            # Programs that a mutation leaves as they are need no new compilation.
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
            # The summary of a failure ends where the terminal does.
            "COLUMNS": "1000",
        }
        if DEFAULT_RECORDINGS.is_dir():
            self.environment.setdefault("TRACKWRIGHT_RECORDINGS", str(DEFAULT_RECORDINGS))

    @cached_property
    def calls(self) -> Calls:
        """Which functions the test files call, by a run of the default suite that traces every program anew."""
        print("recording which tests call which functions ...", flush=True)
        with tempfile.TemporaryDirectory() as calls:
            environment = {**self.environment, FOLDER: calls, "TRACKWRIGHT_CACHE": "off"}
            command = f"{sys.executable} -m pytest --tb=no -p no:cacheprovider -p tests.mutation.calls"
            subprocess.run(command.split(), cwd=self.folder, env=environment, check=False)
            return Calls.read(Path(calls))

    def outcome(self, number: int, mutation: Mutation, limit: float) -> Outcome:
        """The mutation's outcome within `limit` s."""
        begin = time.monotonic()
        original = (self.folder / mutation.file).read_text("utf-8")
        result, by, error = "survived", "", ""
        tests = concerned(self.calls, mutation.file, original, mutation.line)
        self.write(mutation.file, mutation.applied(original))
        try:
            failed = self.first_failure(tests, limit) if tests else None
        finally:
            self.write(mutation.file, original)
        if failed == TIMED_OUT:
            result = failed[0]
        elif failed is not None:
            result, (by, error) = "killed", failed
        return Outcome.of(number, mutation, result, by, error, time.monotonic() - begin)

    def write(self, file: str, text: str) -> None:
        """The file with this text, at a time of its own: Python recognises stale bytecode by the second and the size."""
        self.writes += 1
        (self.folder / file).write_text(text, "utf-8")
        os.utime(self.folder / file, (self.writes, self.writes))

    def first_failure(self, tests: list[str], limit: float) -> tuple[str, str] | None:
        """The first test that fails and its exception, None if all pass, `TIMED_OUT` beyond the limit."""
        if limit <= 0:
            return TIMED_OUT
        options = ["-q", "-x", "-n0", "--tb=no", "-rfE", "-p", "no:cacheprovider"]
        options += [f"--deselect={test}" for test in self.failing]
        command = [sys.executable, "-m", "pytest", *options, *tests]
        process = subprocess.Popen(
            command, cwd=self.folder, env=self.environment, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            return TIMED_OUT
        finally:
            # A session of its own: neither a time limit nor an interrupt may leave processes of a test behind.
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
        if process.returncode in (0, 5):  # 5: every test of these files is a slow one
            return None
        if "while loading conftest" in output:
            return "tests/conftest.py", "ImportError"
        failed = re.search(r"^(?:FAILED|ERROR) (\S+?\.py(?:::.*?)?)(?: - ([\w.]*)[^\n]*)?$", output, re.M)
        if failed is None:
            raise RuntimeError(f"pytest ended with {process.returncode} without a failing test:\n{output[-2000:]}")
        return failed[1], failed[2] or ""

    def failing_anyway(self, tests: set[str]) -> set[str]:
        """Those of the tests that fail without a mutation; from now on they are left out."""
        unknown, found = tests - self.passing, set[str]()
        while unknown and (failed := self.first_failure(sorted(unknown), 3600.0)) is not None:
            if failed == TIMED_OUT:
                raise RuntimeError(f"{len(unknown)} tests take more than an hour without a mutation")
            unknown.discard(failed[0])
            found.add(failed[0])
            self.failing.add(failed[0])
        self.passing |= unknown
        return found


def table(outcomes: list[Outcome]) -> str:
    """The outcomes as lines of text, and their counts."""
    lines = []
    for o in outcomes:
        lines.append(f"{o.number:3d} {o.result:10s} {o.file}:{o.line} ({o.kind})")
        lines += [f"      - {o.before}", f"      + {o.after}"] + ([f"      {o.by} {o.error}".rstrip()] if o.by else [])
    results = [o.result for o in outcomes]
    counts = {kind: results.count(kind) for kind in ("killed", "survived", TIMED_OUT[0], "equivalent")}
    lines.append(", ".join(f"{number} {kind}" for kind, number in counts.items()) + f" of {len(outcomes)}")
    return "\n".join(lines)


def main() -> int:
    """Draw, test and write; 1 where a mutation was neither killed nor equivalent."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--count", type=int, default=60, help="number of mutations")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw")
    parser.add_argument("--since", help="only lines changed since this commit")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for one mutation")
    again = "test again what the file of results has as not killed, or these numbers of it"
    parser.add_argument("--again", type=int, nargs="*", metavar="NUMBER", help=again)
    parser.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    options = parser.parse_args()
    if options.again is None:
        command = ["python", "-m", "tests.mutation", "--seed", str(options.seed), "--count", str(options.count)]
        document = {"command": command + (["--since", options.since] if options.since else []), "commit": _commit()}
        mutations = dict(enumerate(drawn(ROOT, options.count, options.seed, options.since), 1))
        outcomes: dict[int, Outcome] = {}
        waiting = list(mutations)
    else:
        document = json.loads(options.out.read_text("utf-8"))
        outcomes = {o["number"]: Outcome(**o) for o in document["mutations"]}
        mutations = {k: found_again(ROOT, o.file, o.line, o.before, o.after) for k, o in outcomes.items()}
        waiting = options.again or [k for k, o in outcomes.items() if o.result not in ("killed", "equivalent")]
    declared = declared_equivalent()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        scratch = Scratch(Path(folder))
        while waiting:
            number = waiting.pop(0)
            mutation, reason = mutations[number], reason_of(mutations[number], declared)
            outcome = scratch.outcome(number, mutation, options.limit) if reason is None else None
            outcomes[number] = outcome or Outcome.of(number, mutation, "equivalent", str(reason), "", 0.0)
            print(table([outcomes[number]]).rpartition("\n")[0], flush=True)
            _write(options.out, document, outcomes)
            if not waiting:
                # A test that fails in any case has killed nothing.
                found = scratch.failing_anyway({o.by for o in outcomes.values() if o.result == "killed"})
                waiting = [k for k, o in sorted(outcomes.items()) if o.by in found]
    print(table([outcomes[k] for k in sorted(outcomes)]).rpartition("\n")[2])
    return int(any(o.result not in ("killed", "equivalent") for o in outcomes.values()))


def _write(path: Path, document: dict[str, Any], outcomes: dict[int, Outcome]) -> None:
    """The file of results: the command and the commit of the draw, and each outcome with the commit it was tested at."""
    heading = {name: document[name] for name in ("command", "commit")}
    about = {"date": datetime.now(UTC).isoformat(timespec="seconds"), **heading, "python": platform.python_version()}
    write_json(path, {**about, "mutations": [asdict(outcomes[k]) for k in sorted(outcomes)]})


def _commit() -> str:
    command = ["git", "rev-parse", "HEAD"]
    return subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    sys.exit(main())
