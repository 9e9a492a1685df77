"""`trackwright study`."""

from __future__ import annotations

import dataclasses
import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import notice, output_folder, progress
from experiments.cli.manifest import write_manifest
from experiments.monte_carlo.chunk_store import CHUNKS, merge_shards
from experiments.monte_carlo.declaration import checked
from experiments.monte_carlo.runner import StopRule, run_study
from experiments.monte_carlo.sources import available_studies, load_study
from experiments.reports.study import write_study_report
from experiments.reports.study_text import study_names, to_json, to_text
from trackers.core.chunks import n_workers
from trackers.core.errors import UnusableInput
from trackers.recordings.atomic import atomic_write

MERGE = "merge"
RESULTS = "results.json"


def study(
    what: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    out: Path | None = None,
    runs: int | None = None,
    seed: int | None = None,
    until: str | None = None,
    shard: str = "1/1",
    list: bool = False,
) -> int:
    """How accurate would this be? Run a study: worlds × trackers × a grid × runs, with intervals, into report.html.

    `trackwright study NAME` or `FILE.toml` or `FILE.py` runs it, and goes on where it was interrupted. `trackwright
    study merge DIR DIR … --out DIR` puts shards together; run the study once more on that folder for its report.

    Args:
        what: a name that --list shows, or a file; or `merge` and the folders of shards.
        out: the folder to write; default: out/study-NAME.
        runs: trajectories per cell, instead of the study's own number.
        seed: the same seed gives the same numbers, instead of the study's own.
        until: stop a cell when a figure's 95 % interval is this narrow, as "rmse_m±1%"; `runs` is the most then.
        shard: run only part i of n of the chunks, as 2/8, for the jobs of a cluster.
        list: show the studies there are.
    """
    if list:
        print(study_names([load_study(name) for name in available_studies()]))
        return 0
    if not what:
        raise UnusableInput("no study named; expected a name or a file; `trackwright study --list` shows the names")
    if what[0] == MERGE:
        if out is None:
            raise UnusableInput("study merge: expected --out and a folder for all chunks")
        count = merge_shards([Path(x) for x in what[1:]], output_folder(out))
        print(f"wrote {out}: {count} chunks of {len(what) - 1} folders; run the study with --out {out} for its report")
        return 0
    if len(what) > 1:
        raise UnusableInput(f"study: found {len(what)} names ({', '.join(what)}); expected one")
    declared = load_study(what[0])
    changed = {k: v for k, v in {"runs": runs, "seed": seed}.items() if v is not None}
    declared = checked(dataclasses.replace(declared, **changed))  # type: ignore[arg-type]
    enough = None if until is None else StopRule.parse(until, declared)
    part = _shard(shard)
    folder = out or Path("out") / f"study-{declared.name}"
    started = datetime.now(UTC)
    total = len(declared.conditions) * declared.chunks
    notice(
        f"{declared.name}: {declared.about} {len(declared.conditions)} cells × {declared.runs} runs × "
        f"{len(declared.trackers)} trackers in {total} chunks of {declared.chunk}, "
        f"{n_workers()} at a time"
    )
    with progress(declared.name, total // part[1] if part[1] > 1 else total) as advance:
        results = run_study(declared, folder, part, enough, advance)
    if results is None:
        have = len([*(folder / CHUNKS).glob("*.npz")])
        print(f"{folder}: {have} of {total} chunks; `trackwright study merge` puts the shards together")
        return 0
    claims = [] if declared.expected is None else declared.expected(results)
    print(to_text(results, claims), end="")
    atomic_write(folder / RESULTS, lambda path: path.write_text(to_json(results, claims), "utf-8"))
    drawn = [] if declared.draw is None else declared.draw(results, folder)
    written = write_study_report(folder, results, claims, drawn, sys.argv)
    write_manifest(folder, sys.argv, {"study": declared.name, "runs": declared.runs}, started, (declared.seed,),
                   declared.chunk)  # fmt: skip
    print(f"wrote {written}, {RESULTS}, manifest.json" + (f" and {', '.join(drawn)}" if drawn else ""))
    return 0


def _shard(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise UnusableInput(f"--shard {text}: expected i/n with i from 1 to n, as 2/8")
    return int(found[1]), int(found[2])
