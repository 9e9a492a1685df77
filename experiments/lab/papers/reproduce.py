"""All reproductions of the four papers: `python -m trackwright.experiments.lab.papers.reproduce` (`make papers`).

Every study is run into out/papers/NAME and resumes if interrupted; every number is read from a results.json.
"""

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import polars as pl

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.lab.runner import new_interpreter
from trackwright.experiments.monte_carlo import Value
from trackwright.experiments.monte_carlo.sources import available_studies, load_study
from trackwright.experiments.text.expectations import headline, ratio_text, with_interval
from trackwright.experiments.text.tables import Unit, markdown, replace_tables
from trackwright.experiments.text.terminal import notice, stages

LIMIT_S = 1800.0
MODULE = "trackwright.experiments.lab.papers.reproduce"
RESULTS, EVIDENCE = Path("docs/results.md"), Path("docs/evidence/papers.csv")
HEAD = ("result", "printed", "ours", "ratio", "origin", "within tolerance")


def main(*, out: Path = Path("out/papers"), results: Path = RESULTS) -> int:
    """Run all studies with expected results and write the tables of their page; 1 if a study fails.

    Args:
        out: the folder of the studies.
        results: the page.
    """
    chosen = [study for study in map(load_study, available_studies()) if study.expected is not None]
    contents, failed, seconds = [], [], 0.0
    with stages("papers") as begin:
        advance = begin("papers", len(chosen))
        for study in chosen:
            folder = out / study.name
            words = ["-m", "trackwright", "study", study.name, "--out", str(folder)]
            try:
                new_interpreter(words, LIMIT_S)
            except RuntimeError as problem:
                failed.append(study.name)
                notice(f"{study.name} failed: {problem}")
            else:
                content = json.loads((folder / "results.json").read_text("utf-8"))
                contents.append(content)
                seconds += content["computing_s"]
                notice(f"{study.name}: {content['computing_s']:.0f} s")
            advance(1, study.name)
    if failed:
        notice(f"{results} is unchanged: {', '.join(failed)} failed")
        return 1
    replace_tables(results, MODULE, tables(contents, seconds))
    EVIDENCE.parent.mkdir(exist_ok=True)
    evidence(contents).write_csv(EVIDENCE, float_precision=6)
    print(f"wrote {results} and {EVIDENCE}")
    return 0


def tables(contents: Sequence[dict[str, Any]], seconds: float) -> str:
    """The sections of all studies, from their results.json."""
    machine = f"{os.cpu_count()} cores, {platform.machine()}, jax {version('jax')}, Python {platform.python_version()}"
    claims = [claim for content in contents for claim in content["claims"]]
    heading = f"**{_headline(claims)}**\n\n{machine}; {seconds / 60:.0f} minutes of computing.\n"
    return "\n".join([heading, *map(part, contents)])


def part(content: dict[str, Any]) -> str:
    """The section of a study, from its results.json."""
    printed = [claim for claim in content["claims"] if "printed" in claim]
    stated = [claim for claim in content["claims"] if "says" in claim]
    paragraphs = [f"## {content['study']}", f"{content['about']} **{_headline(content['claims'])}**"]
    if printed:
        paragraphs.append(markdown([HEAD, *map(_row, printed)]).rstrip())
    conclusions = [
        f"- {'Holds' if c['holds'] else '**Does not hold**'} (*{c['origin']}*): {c['says']}." for c in stated
    ]
    return "\n\n".join([*paragraphs, *(["\n".join(conclusions)] if conclusions else [])]) + "\n"


def evidence(contents: Sequence[dict[str, Any]]) -> pl.DataFrame:
    """A row for each printed number and each conclusion, with what speaks for it."""
    rows = []
    for content in contents:
        for c in content["claims"]:
            number = "printed" in c
            rows.append({
                "study": content["study"], "claim": c["figure"] if number else c["says"], "origin": c["origin"],
                "printed": c.get("printed"), **(c["ours"] if number else dict.fromkeys(Value._fields)),
                "unit": c.get("unit"), "holds": c["reached"] if number else c["holds"],
                "evidence": c["note"] if number else c["evidence"],
            })  # fmt: skip
    return pl.DataFrame(rows, infer_schema_length=None)


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
    run_alone(main, f"python -m {MODULE}")
