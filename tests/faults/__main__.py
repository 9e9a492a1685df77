"""`python -m tests.faults KIND --count 1000 --seed 0`: broken input through the command line, in process.

Prints one line for each case that fails, with the words that repeat it, and counts by exit code. Two words are other
programs: `table`, faults of processes and disks, and `soak`, long runs.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections import Counter
from importlib import import_module
from pathlib import Path

from tests.faults.cases import CASES


def main() -> int:
    """Runs the cases; exit code 1 if one fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("kind", choices=sorted(CASES))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after so many seconds")
    asked = parser.parse_args()
    codes, failed, began = Counter(), 0, time.monotonic()
    for number in range(asked.first, asked.first + asked.count):
        if time.monotonic() - began > asked.seconds:
            break
        place = Path(tempfile.mkdtemp(prefix="faults-"))
        try:
            words, wrong, code = CASES[asked.kind](asked.seed, number, place)
        finally:
            shutil.rmtree(place, ignore_errors=True)
        codes[code] += 1
        if wrong:
            failed += 1
            print(
                f"--seed {asked.seed} --first {number} --count 1: {words}: {wrong}"[:1500]
                .encode("ascii", "backslashreplace")
                .decode(),
                flush=True,
            )
    counts = ", ".join(f"exit code {code}: {n}" for code, n in sorted(codes.items()))
    seconds = time.monotonic() - began
    print(f"{asked.kind}, seed {asked.seed}: {codes.total()} cases in {seconds:.0f} s, {failed} failed; {counts}")
    return int(failed > 0)


if sys.argv[1:2] in (["table"], ["soak"]):
    # Begun here, since the workers of a cluster import again what a program imports that is no `__main__`.
    sys.exit(import_module(f"tests.faults.{sys.argv.pop(1)}").main())
sys.exit(main())
