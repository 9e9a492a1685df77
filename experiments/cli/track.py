"""`trackwright track`, `evaluate`, `tune` and `sweep`; the modules that they import do the work."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from cyclopts import Parameter

from trackwright.experiments.cli.options import (
    EvaluateOptions,
    Name,
    Numbers,
    Out,
    Readings,
    Recording,
    TrackOptions,
    TuneOptions,
)
from trackwright.trackers.core.errors import UnusableInput

DEFAULTS, NUMBERS, READINGS = EvaluateOptions(), Numbers(), Readings()


def track(*recordings: Recording, options: TrackOptions) -> int:
    """Track recordings: estimates, error metrics, a page with playback.

    Writes tracks.parquet, report.html and manifest.json; prints error metrics where there is truth. With a folder of
    folders, more than 60 recordings or --cluster each recording is tracked by itself and kept, so that the same command
    continues, and those that fail are left out, with exit code 3.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
    """
    from trackwright.experiments.cli.console import prepared
    from trackwright.experiments.text.terminal import stages
    from trackwright.trackers.recordings.folder import archive_of

    options.numbers.read()
    with stages("track") as begin:
        # jax takes a second to import, which a refused recording need not wait for.
        if archive := archive_of(recordings, options.cluster is not None):
            from trackwright.experiments.cli.archive import track_archive

            return track_archive(archive, options, begin)
        refused = list[str]()
        folders = prepared(recordings, options.used, begin, options.force, refused)
        from trackwright.experiments.cli.tracking import track_together

        return track_together(folders, refused, options, begin)


def evaluate_tracks(*runs: Recording, options: EvaluateOptions = DEFAULTS) -> int:
    """Error metrics of estimates against truth; a comparison of runs.

    By track, by recording and overall; writes evaluation.json. Of a file of estimates (TUM, or a table with t_s, x_m,
    y_m), and with --align and what follows it, also absolute and relative pose errors as in evo. Of several runs: their
    metrics side by side, and each one's differences from the first, with --out alone.

    Args:
        runs: a folder of `track`, of any number of recordings, or a file of estimates; to compare, several folders.
    """
    from trackwright.experiments.cli.evaluating import evaluate_poses, evaluate_run, print_comparison

    run, truth = runs[0], options.truth
    if len(runs) > 1:
        if options != EvaluateOptions(out=options.out):
            raise UnusableInput(f"evaluate: {len(runs)} runs to compare; expected no option but --out")
        print_comparison(runs, options.out)
        return 0
    if options.out is not None:
        raise UnusableInput("evaluate: --out is the folder for a comparison; expected two runs or more; leave it out")
    if not run.exists():
        raise UnusableInput(f"{run}: no such file; expected a folder with tracks.parquet, or a file of estimates")
    plain = replace(options, align=None, rpe=(), time_offset=0.0, time_tolerance=DEFAULTS.time_tolerance)
    of_poses = run.is_file() or options != plain or not all(path.is_dir() for path in truth)
    return (evaluate_poses if of_poses else evaluate_run)(run, options)


def tune(*recordings: Recording, options: TuneOptions) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
    """
    from trackwright.experiments.cli.console import prepared
    from trackwright.experiments.text.terminal import stages

    options.numbers.read()
    with stages("tune") as begin:
        folders = prepared((*recordings, *options.held_out), options.used, begin)
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.tuning import tune_folders

        return tune_folders(folders, len(recordings), options, begin)


def sweep(
    *recordings: Recording, out: Out,
    over: Annotated[tuple[str, ...], Parameter(metavar="PATTERN=START:STOP:COUNT[:log]...")],
    objective: Name = "rmse", numbers: Numbers = NUMBERS, used: Readings = READINGS,
) -> int:  # fmt: skip
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
        out: the folder to write to.
        over: a shell pattern of tunables, tied, and their values; once or twice. ':log' makes equal ratios.
        objective: rmse (horizontal; needs truth), nll, or another objective of `tune`.
    """
    from trackwright.experiments.cli.console import prepared
    from trackwright.experiments.text.terminal import stages
    from trackwright.tuning.tuned_file import parse_grids

    numbers.read()
    grids = parse_grids(over, "--over")
    with stages("sweep") as begin:
        folders = prepared(recordings, used, begin)
        from trackwright.experiments.cli.tuning import sweep_folders

        sweep_folders(folders, grids, objective, numbers, out, begin)
    return 0
