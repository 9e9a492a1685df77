"""All reproductions of the four papers: `python -m trackwright.experiments.lab.papers.reproduce` (`make papers`).

Every study is run as `trackwright study NAME --out out/papers/NAME` and resumes if interrupted. The results are written
to docs/results.md; every number there is read from a results.json.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.subprocesses import new_interpreter
from trackwright.experiments.monte_carlo import Value
from trackwright.experiments.monte_carlo.sources import available_studies, load_study
from trackwright.experiments.text.tables import markdown
from trackwright.experiments.text.terminal import notice, progress
from trackwright.experiments.text.wording import Unit, headline, ratio_text, with_interval
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write

LIMIT_S = 1800.0
RESULTS = Path("docs/results.md")
HEAD = ("result", "printed", "ours", "ratio", "origin", "within tolerance")


def main(*, out: Path = Path("out/papers"), results: Path = RESULTS) -> int:
    """Run all studies with expected results and write the page of their results; 1 if a study fails.

    Args:
        out: the folder of the studies.
        results: the page to write.
    """
    chosen = [study for study in map(load_study, available_studies()) if study.expected is not None]
    every, failed, seconds = [], [], 0.0
    with progress("papers", len(chosen)) as advance:
        for study in chosen:
            folder = out / study.name
            done = new_interpreter(
                ["-m", "trackwright.experiments", "study", study.name, "--out", str(folder)], LIMIT_S
            )
            if done.returncode:
                failed.append(study.name)
                notice(f"{study.name} failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
            else:
                found = json.loads((folder / "results.json").read_text("utf-8"))
                every.append(found)
                seconds += found["computing_s"]
                notice(f"{study.name}: {found['computing_s']:.0f} s")
            advance(1, study.name)
    if failed:
        notice(f"{results} is unchanged: {', '.join(failed)} failed")
        return 1
    text = page(every, seconds)
    try:
        print(f"wrote {atomic_write(results, lambda path: path.write_text(text, 'utf-8'))}")
    except UnusableInput as problem:
        print(f"papers: {problem}", file=sys.stderr)
        return 2
    return 0


def page(found: Sequence[dict[str, Any]], seconds: float) -> str:
    """The page of all studies, from their results.json."""
    machine = f"{os.cpu_count()} cores, {platform.machine()}, jax {version('jax')}, Python {platform.python_version()}"
    claims = [claim for one in found for claim in one["claims"]]
    return f"""# Printed and reproduced results

**{_headline(claims)}**

Written by `make papers` ({machine}; {seconds / 60:.0f} minutes of computing). Every number is read from the
results of a study, which `trackwright study NAME` runs again; where a number is read from a file instead, the file
and the command that writes it are named. The study's report has all metrics and plots. Brackets are 95 % intervals over
the study's runs.

- *Fitted*: parameters that the paper does not print were adjusted to the printed number (see the README of the paper's
  folder in `experiments/lab/papers`), or a choice was made after seeing it.
- *Derived*: the number follows from others by a formula or by symmetry, or is printed twice; it is shown and not
  counted again. A conclusion is derived if a number that it rests on is fitted or derived.
- *Predicted*: neither. A number counts as within tolerance up to 10 % from the printed one.
  Shares above one half are compared by the rest, "(rest)": 98.3 % and 93.7 % differ as 1.7 % and 6.3 % do.

{chr(10).join(map(part, found))}"""


def part(found: dict[str, Any]) -> str:
    """The section of a study, from its results.json."""
    printed = [claim for claim in found["claims"] if "printed" in claim]
    stated = [claim for claim in found["claims"] if "says" in claim]
    paragraphs = [f"## {found['study']}", found["about"], f"**{_headline(found['claims'])}**"]
    if printed:
        paragraphs.append(markdown([HEAD, *map(_row, printed)]).rstrip())
    notes = [f"- {claim['figure']}: {claim['note']}" for claim in printed if claim["note"]]
    conclusions = [
        f"- {'Holds' if c['holds'] else '**Does not hold**'} (*{c['origin']}*): {c['says']}. {c['evidence']}"
        for c in stated
    ]
    paragraphs += ["\n".join(lines) for lines in (notes, conclusions) if lines]
    return "\n\n".join(
        [*paragraphs, f"`trackwright study {found['study']}`, {found['computing_s']:.0f} s of computing.\n"]
    )


def _headline(claims: Sequence[dict[str, Any]]) -> str:
    return headline(
        [(c["origin"], c["reached"]) for c in claims if "printed" in c],
        [(c["origin"], c["holds"]) for c in claims if "says" in c],
    )


def _row(claim: dict[str, Any]) -> tuple[str, ...]:
    ours = Value(*(float("nan") if claim["ours"][k] is None else claim["ours"][k] for k in Value._fields))
    reached = {True: "yes", False: "**no**", None: ""}[claim["reached"]]
    value, printed = with_interval(ours, Unit(claim["unit"], 1.0)), f"{claim['printed']:g} {claim['unit']}"
    ratio = ratio_text(claim["ratio"], claim["compares_rest"])
    return claim["figure"], printed, value, ratio, claim["origin"], reached


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.papers.reproduce")
