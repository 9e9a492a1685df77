"""`trackwright study`."""

from __future__ import annotations

import dataclasses
import re
import sys
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import Address, Figures, Folder, file_format, require_output
from trackwright.trackers.core.errors import UnusableInput

MERGE = "merge"
RESULTS = "results.json"


def study(
    *what: Annotated[str, Parameter(name="STUDY")], out: Folder | None = None, runs: int | None = None,
    seed: int | None = None, until: Annotated[str, Parameter(metavar="METRIC±WIDTH")] | None = None,
    shard: Annotated[str, Parameter(metavar="I/N")] = "1/1", cluster: Address | None = None, list: bool = False,
    figures: Figures = "page",
) -> int:  # fmt: skip
    """Run a Monte Carlo study: worlds × trackers × a grid × runs.

    Writes report.html and results.json. `trackwright study NAME`, `FILE.toml` or `FILE.py` runs a study, or
    continues an interrupted one. `trackwright study merge DIR DIR … --out DIR` merges shards; run the study again with
    that --out for its report.

    Args:
        what: a name from --list, or a file; or `merge` and the folders of shards.
        out: output folder; default: out/study-NAME.
        runs: trajectories per condition (a world at a grid point); default: the study's own number.
        seed: seed of the random numbers; default: the study's own.
        until: stop a condition when the 95 % interval of a metric is this narrow, e.g. "rmse_m±1%", or after `runs`.
        shard: run only part i of n of the chunks, e.g. 2/8, for an array of jobs.
        cluster: run the chunks on a Dask cluster, tcp://HOST:8786, or in processes here, local:4 (docs/cluster.md).
        list: list the studies that come with the package.
        figures: page, report.html; png or pdf, also its charts as files; or none.
    """
    if out is not None:
        require_output(out)
    from trackwright.experiments.cli.console import output_folder
    from trackwright.experiments.cli.runtime import keep_programs, write_manifest
    from trackwright.experiments.jobs.executors import cluster_executor
    from trackwright.experiments.monte_carlo.chunk_store import CHUNKS, merge_shards
    from trackwright.experiments.monte_carlo.declaration import checked
    from trackwright.experiments.monte_carlo.runner import StopRule, run_study
    from trackwright.experiments.monte_carlo.sources import available_studies, load_study
    from trackwright.experiments.pages.charts.drawing import write_charts
    from trackwright.experiments.pages.reports.pages import write_page
    from trackwright.experiments.pages.reports.study import (
        REPORT,
        study_charts,
        study_names,
        study_page,
        to_json,
        to_text,
    )
    from trackwright.experiments.text.terminal import notice, progress
    from trackwright.experiments.text.wording import figures_drawn
    from trackwright.trackers.core.run.chunks import n_workers
    from trackwright.trackers.core.wording import counted
    from trackwright.trackers.recordings.atomic import atomic_write

    if list:
        print(study_names([load_study(name) for name in available_studies()]))
        return 0
    keep_programs()
    if not what:
        raise UnusableInput("no study given; expected a name or a file; `trackwright study --list` lists the names")
    if what[0] == MERGE:
        if out is None:
            raise UnusableInput("study merge: no --out given; expected a folder for the merged chunks")
        count = merge_shards([Path(x) for x in what[1:]], output_folder(out))
        print(f"wrote {out}: {count} chunks of {len(what) - 1} shards; run the study with --out {out} for its report")
        return 0
    if len(what) > 1:
        raise UnusableInput(f"study: found {len(what)} names ({', '.join(what)}); expected one")
    declared = load_study(what[0])
    changed = {k: v for k, v in {"runs": runs, "seed": seed}.items() if v is not None}
    declared = checked(dataclasses.replace(declared, **changed))  # type: ignore[arg-type]
    stop = None if until is None else StopRule.parse(until, declared)
    part = _shard(shard)
    folder = out or Path("out") / f"study-{declared.name}"
    started = datetime.now(UTC)
    total = len(declared.conditions) * declared.chunks
    with cluster_executor(cluster) if cluster else nullcontext() as executor:
        notice(
            f"{declared.name}: {declared.about} {counted(len(declared.conditions), 'condition')} × "
            f"{counted(declared.runs, 'run')} × {counted(len(declared.trackers), 'tracker')} in "
            f"{counted(total, 'chunk')} of {declared.chunk}, "
            + (f"on {cluster}" if cluster else f"{n_workers()} in parallel")
        )
        with progress(declared.name, total // part[1] if part[1] > 1 else total) as advance:
            results = run_study(declared, folder, part, stop, advance, executor)
    if results is None:
        finished = len([*(folder / CHUNKS).glob("[0-9]*.npz")])
        print(f"{folder}: {finished} of {total} chunks; merge the shards with `trackwright study merge`")
        return 0
    expected = [] if declared.expected is None else [*declared.expected(results)]
    print(to_text(results, expected), end="")
    atomic_write(folder / RESULTS, lambda path: path.write_text(to_json(results, expected), "utf-8"))
    written = [RESULTS, "manifest.json"]
    if kind := file_format(figures):
        charts = [chart for group in study_charts(results) for chart in group]
        written.append(figures_drawn(write_charts(folder, charts, kind)))
    if figures != "none":
        written.insert(0, write_page(folder / REPORT, study_page(results, expected, sys.argv)).name)
    write_manifest(folder, sys.argv, {"study": declared.name, "runs": declared.runs}, started, (declared.seed,),
                   declared.chunk)  # fmt: skip
    print(f"wrote {', '.join([str(folder / written[0]), *written[1:]])}")
    return 0


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UnusableInput(f"--shard {text}: expected i/n with i from 1 to n, e.g. 2/8")
    return int(match[1]), int(match[2])
