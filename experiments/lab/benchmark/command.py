"""`trackwright benchmark`."""

from __future__ import annotations

from pathlib import Path


def benchmark(
    *,
    estimator: tuple[str, ...] = (),
    data: tuple[str, ...] = (),
    out: Path = Path("out/benchmark"),
    mine: Path | None = None,
    page: Path | None = None,
) -> int:
    """Compare estimators on public recordings and simulated worlds, ours and those of other libraries.

    Runs each estimator on each data set, writes its estimates as ESTIMATOR/DATASET.parquet in a folder, and scores all
    that the folder has. Others score theirs by the same code (docs/side-by-side.md). Recordings are found in
    TRACKWRIGHT_RECORDINGS.

    Args:
        estimator: run these alone; default: all.
        data: these data sets alone; default: all.
        out: the folder of estimates.
        mine: score the estimates of this folder, ESTIMATOR/DATASET.tum, or of one file, DATASET.tum; run nothing.
        page: the page whose tables and chart are replaced, as docs/side-by-side.md.
    """
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.lab.benchmark.data import names
    from trackwright.experiments.lab.benchmark.declaration import ESTIMATORS
    from trackwright.experiments.lab.benchmark.table import scored, show
    from trackwright.experiments.lab.cases import chosen
    from trackwright.experiments.text.tables import require_page

    if page is not None:
        require_page(page)
    sets = chosen(data, names())
    if mine is None:
        keep_programs()
        _run(chosen(estimator, ESTIMATORS), sets, out)
    show(scored(out if mine is None else mine, sets), page)
    return 0


def _run(estimators: tuple[str, ...], sets: tuple[str, ...], out: Path) -> None:
    from importlib.util import find_spec

    from trackwright.experiments.lab.benchmark.data import folder_of
    from trackwright.experiments.lab.benchmark.declaration import ESTIMATORS
    from trackwright.experiments.lab.benchmark.problems import problems
    from trackwright.experiments.lab.benchmark.running import write
    from trackwright.experiments.text.terminal import notice, progress

    ready = []
    for name in estimators:
        library = ESTIMATORS[name].library
        if library and find_spec(library) is None:
            notice(f"notice: {name}: {library} is not installed; left out; pip install 'trackwright[peers]'")
        else:
            ready.append(name)
    with progress("benchmark", len(ready) * len(sets)) as advance:
        for data in sets:
            folder = folder_of(data)
            given = problems(folder)
            for name in ready:
                reason = write(out, name, folder, given)
                if reason is not None:
                    notice(f"notice: {name} on {data}: {reason}")
                advance(1)
