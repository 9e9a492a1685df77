"""`trackwright study`."""

from __future__ import annotations

import dataclasses
import re
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import Address, Figures, Out, file_format
from trackwright.trackers.core.errors import UnusableInput


def study(
    *what: Annotated[str, Parameter(name="STUDY")], out: Out | None = None, runs: int | None = None,
    seed: int | None = None, until: Annotated[str, Parameter(metavar="METRIC±WIDTH")] | None = None,
    shard: Annotated[str, Parameter(metavar="I/N")] = "1/1", cluster: Address | None = None, list: bool = False,
    figures: Figures = "page",
) -> int:  # fmt: skip
    """Run a Monte Carlo study: worlds × trackers × a grid × runs.

    Writes report.html and results.json. `trackwright study NAME`, `FILE.toml` or `FILE.py` runs a study, or
    continues an interrupted one.

    Args:
        what: a name from --list, or a file.
        out: output folder; default: out/study-NAME.
        runs: trajectories per condition (a world at a grid point); default: the study's own number.
        seed: seed of the random numbers; default: the study's own.
        until: stop a condition when the 95 % interval of a metric is this narrow, e.g. "rmse_m±1%", or after `runs`.
        shard: run only part i of n of the chunks, e.g. 2/8, for an array of jobs with one --out; the last reports.
        cluster: run the chunks on a Dask cluster, tcp://HOST:8786, or in processes here, local:4 (docs/cluster.md).
        list: list the studies that come with the package.
        figures: page, report.html; png or pdf, also its charts as files; or none.
    """
    from trackwright.experiments.cli.console import keep_programs, running, write_manifest
    from trackwright.experiments.jobs.executors import cluster_executor
    from trackwright.experiments.monte_carlo.declaration import checked
    from trackwright.experiments.monte_carlo.runner import StopRule, run_study
    from trackwright.experiments.monte_carlo.sources import available_studies, load_study
    from trackwright.experiments.monte_carlo.store import CHUNKS
    from trackwright.experiments.pages import study as pages
    from trackwright.experiments.pages.report import write_page
    from trackwright.experiments.text.terminal import notice
    from trackwright.experiments.text.wording import figures_drawn
    from trackwright.trackers.core.run.chunks import n_workers
    from trackwright.trackers.core.wording import counted
    from trackwright.trackers.recordings.atomic import write_whole

    if list:
        print(pages.study_names([load_study(name) for name in available_studies()]))
        return 0
    keep_programs()
    if not what:
        raise UnusableInput("no study given; expected a name or a file; `trackwright study --list` lists the names")
    if len(what) > 1:
        raise UnusableInput(f"study: found {len(what)} names ({', '.join(what)}); expected one")
    match = re.fullmatch(r"\s*(\d+)\s*/\s*(\d+)\s*", shard)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UnusableInput(f"--shard {shard}: expected i/n with i from 1 to n, e.g. 2/8")
    declared = load_study(what[0])
    declared = checked(dataclasses.replace(
        declared, runs=declared.runs if runs is None else runs, seed=declared.seed if seed is None else seed
    ))  # fmt: skip
    stop = None if until is None else StopRule.parse(until, declared)
    part, folder = (int(match[1]), int(match[2])), out or Path("out") / f"study-{declared.name}"
    total = len(declared.conditions) * declared.chunks
    with running("study", False) as run, cluster_executor(cluster) if cluster else nullcontext() as executor:
        notice(
            f"{declared.name}: {declared.about} {counted(len(declared.conditions), 'condition')} × "
            f"{counted(declared.runs, 'run')} × {counted(len(declared.trackers), 'tracker')} in "
            f"{counted(total, 'chunk')} of {declared.chunk}, "
            + (f"on {cluster}" if cluster else f"{n_workers()} in parallel")
        )
        results = run_study(declared, folder, part, stop, run.begin(declared.name, total // part[1]), executor)
    if results is None:
        done = len([*(folder / CHUNKS).glob("[0-9]*.npz")])
        print(f"{folder}: {done} of {total} chunks; run the other shards with the same --out")
        return 0
    expected = [] if declared.expected is None else [*declared.expected(results)]
    print(pages.to_text(results, expected), end="")
    write_whole(folder / "results.json", pages.to_json(results, expected))
    written = ["results.json", "manifest.json"]
    if kind := file_format(figures):
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.chart import write_charts

        written.append(figures_drawn(write_charts(folder, pages.study_charts(results), kind)))
    if figures != "none":
        page = pages.study_page(results, expected, sys.argv)
        written.insert(0, write_page(folder / pages.REPORT, page).name)
    config = {"study": declared.name, "runs": declared.runs}
    write_manifest(folder, config, run.started, seeds=[declared.seed], chunk=declared.chunk)
    print(f"wrote {', '.join([str(folder / written[0]), *written[1:]])}")
    return 0
