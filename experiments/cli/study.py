"""`trackwright study`."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import Cluster, Figures, Out


def study(
    what: Annotated[str, Parameter(name="STUDY")] = "", /, *, out: Out | None = None, runs: int | None = None,
    seed: int | None = None, cluster: Cluster | None = None, figures: Figures = "page",
) -> int:  # fmt: skip
    """Run a Monte Carlo study: worlds × trackers × a grid × runs.

    Writes report.html and results.json. An interrupted study continues; without a name those of the package are listed.

    Args:
        what: a name from the list, or a file.
        out: output folder; default: out/study-NAME.
        runs: trajectories per condition (a world at a grid point); default: the study's own number.
        seed: seed of the random numbers; default: the study's own.
        cluster: run the chunks on a Dask cluster, tcp://HOST:8786, or in processes here, local:4 (docs/cluster.md).
        figures: page, report.html; png or pdf, also its charts as files; or none.
    """
    from trackwright.experiments.cli.console import keep_programs, write_manifest
    from trackwright.experiments.jobs.executors import cluster_executor
    from trackwright.experiments.monte_carlo.runner import run_study
    from trackwright.experiments.monte_carlo.sources import available_studies, load_study
    from trackwright.experiments.pages import study as pages
    from trackwright.experiments.pages.report import write_page
    from trackwright.experiments.text.tables import figures_drawn
    from trackwright.experiments.text.terminal import stages
    from trackwright.trackers.recordings.files import write_whole

    if not what:
        studies = [load_study(name) for name in available_studies()]
        width = max(len(one.name) for one in studies)
        print("\n".join(f"{one.name:{width}}  {one.about}" for one in studies))
        return 0
    keep_programs()
    declared = load_study(what, runs, seed)
    folder, total = out or Path("out") / f"study-{declared.name}", len(declared.conditions) * declared.chunks
    with stages("study") as begin, cluster_executor(cluster) if cluster else nullcontext() as executor:
        results = run_study(declared, folder, begin(declared.name, total), executor)
    expected = [] if declared.expected is None else [*declared.expected(results)]
    print(pages.to_text(results, expected), end="")
    write_whole(folder / "results.json", pages.to_json(results, expected))
    written = ["results.json", "manifest.json"]
    if figures == "png" or figures == "pdf":
        # matplotlib takes a third of a second to import.
        from trackwright.experiments.pages.chart import write_charts

        written.append(figures_drawn(write_charts(folder, pages.study_charts(results), figures)))
    if figures != "none":
        page = pages.study_page(results, expected, sys.argv)
        written.insert(0, write_page(folder / pages.REPORT, page).name)
    write_manifest(folder, study=declared.name, runs=declared.runs, seed=declared.seed)
    print(f"wrote {', '.join([str(folder / written[0]), *written[1:]])}")
    return 0
