"""`trackwright track`, `evaluate`, `tune` and `sweep`; the modules that they import do the work."""

from __future__ import annotations

from trackwright.experiments.cli.options import (
    EvaluateOptions,
    PoseOptions,
    Recording,
    SweepOptions,
    TrackOptions,
    TuneOptions,
)
from trackwright.trackers.core.errors import UnusableInput


def track(*recordings: Recording, options: TrackOptions) -> int:
    """Track recordings: estimates, error metrics, a page with playback.

    Writes tracks.parquet, report.html and manifest.json; prints error metrics where there is truth. With a folder of
    folders, more than 60 recordings or --cluster each recording is tracked by itself and kept, so that the same command
    continues, and those that fail are left out, with exit code 3.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running
    from trackwright.trackers.recordings.atomic import json_text
    from trackwright.trackers.recordings.folder import archive_of

    options.read()
    with running("track", options.json) as begin:
        begin("reading")
        refused = list[str]()
        archive = archive_of(recordings, options.cluster is not None)
        folders = [] if archive else prepared(recordings, options.used, options.force, refused)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        if archive:
            from trackwright.experiments.cli.archive import track_archive

            code, found = track_archive(archive, options, begin)
        else:
            from trackwright.experiments.cli.tracking import track_together

            code, found = track_together(folders, refused, options, begin)
    if options.json:
        print(json_text(found), end="")
    return code


DEFAULTS = EvaluateOptions()


def evaluate_tracks(*runs: Recording, options: EvaluateOptions = DEFAULTS) -> int:
    """Error metrics of estimates against truth; a comparison of runs.

    By track, by recording and overall; writes evaluation.json. Of a file of estimates (TUM, or a table
    with t_s, x_m, y_m), and with --align and what follows it, also absolute and relative pose errors as in evo.

    Of several runs: their metrics side by side, and each one's differences from the first, with --json and --out alone.

    Args:
        runs: the output folder of `track`, of one recording, several or an archive, or a file of estimates, of one
            tag, which --tag names; to compare, two or more folders of `track`.
    """
    from trackwright.experiments.cli.evaluating import evaluate_poses, evaluate_run, print_comparison
    from trackwright.trackers.recordings.tracks_table import require_sources

    run, poses, truth = runs[0], options.poses, options.truth
    if len(runs) > 1:
        if options != EvaluateOptions(json=options.json, poses=PoseOptions(out=poses.out)):
            raise UnusableInput(f"evaluate: {len(runs)} runs to compare; expected no option but --json and --out")
        print_comparison(runs, poses.out, json=options.json)
        return 0
    if not run.exists():
        raise UnusableInput(f"{run}: no such file; expected a folder with tracks.parquet, or a file of estimates")
    if run.is_file() or poses != PoseOptions() or not all(path.is_dir() for path in truth):
        return evaluate_poses(run, truth if truth or run.is_file() else require_sources(run), options)
    return evaluate_run(run, options)


def tune(*recordings: Recording, options: TuneOptions) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    with running("tune") as begin:
        begin("reading")
        folders = prepared((*recordings, *options.held_out), options.used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.tuning import tune_folders

        return tune_folders(folders, len(recordings), options, begin)


def sweep(*recordings: Recording, options: SweepOptions) -> int:
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    _ = options.grids
    with running("sweep") as begin:
        begin("reading")
        folders = prepared(recordings, options.used)
        begin("preparing")
        keep_programs()
        from trackwright.experiments.cli.tuning import sweep_folders

        return sweep_folders(folders, options, begin)
