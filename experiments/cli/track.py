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
    """Track recordings: estimates, events, error metrics, a page with playback.

    Writes tracks.parquet, events.parquet, report.html and manifest.json; prints error metrics where there is
    truth.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
    """
    from trackwright.experiments.cli.console import keep_programs, notices, prepared, running
    from trackwright.trackers.recordings.folder import archive_of

    options.read()
    if options.noise is not None and options.tuned is not None:
        notices(filter(None, [options.tuned.other_calibration(options.noise, options.used.calibration)]))
    with running("track", options.json) as run:
        run.begin("reading")
        archive = archive_of(recordings, options.keep_going or options.cluster is not None)
        if archive is None:
            refused: list[str] = []
            folders = prepared(recordings, options.used, options.force, refused=refused)
        run.begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        if archive is not None:
            from trackwright.experiments.cli.archive import track_archive

            return track_archive(archive, options, run)
        from trackwright.experiments.cli.tracking import track_together

        return track_together(folders, refused, options, run)


DEFAULTS = EvaluateOptions()


def evaluate_tracks(*runs: Recording, options: EvaluateOptions = DEFAULTS) -> int:
    """Error metrics of estimates against truth; a comparison of runs.

    By track, by recording and overall; writes evaluation.json. Of a file of estimates (TUM, KITTI, EuRoC, or a table
    with t_s, x_m, y_m), and with --align and what follows it, also absolute and relative pose errors as in evo.

    Of several runs: their metrics side by side, and each one's differences from the first, with --json and --out alone.

    Args:
        runs: the output folder of `track`, of one recording, several or an archive, or a file of estimates, of one
            tag, which --tag names; to compare, two or more folders of `track`, or two or more of `study`.
    """
    from trackwright.experiments.cli.evaluating import (
        evaluate_archive,
        evaluate_folder,
        evaluate_poses,
        print_comparison,
    )  # fmt: skip
    from trackwright.trackers.recordings.tracks_table import RECORDINGS, RESULTS, require_sources

    folder, poses, truth = runs[0], options.poses, options.truth
    if len(runs) > 1:
        if options != EvaluateOptions(json=options.json, poses=PoseOptions(out=poses.out)):
            raise UnusableInput(f"evaluate: {len(runs)} runs to compare; expected no option but --json and --out")
        print_comparison(runs, poses.out, json=options.json)
        return 0
    if not folder.exists():
        raise UnusableInput(f"{folder}: no such file; expected a folder with tracks.parquet, or a file of estimates")
    if (folder / RECORDINGS).is_dir():
        if not (folder / RESULTS).is_file():
            raise UnusableInput(f"{folder}: an archive that was not tracked to its end; run the same `track` again")
        if poses != PoseOptions() or truth:
            fix = f"expected no --truth and trajectory options; evaluate one of {folder / RECORDINGS}/*/*"
            raise UnusableInput(f"{folder}: is an archive; {fix}")
        return evaluate_archive(folder, options)
    if folder.is_file() or poses != PoseOptions() or not all(path.is_dir() for path in truth):
        return evaluate_poses(folder, truth if truth or folder.is_file() else require_sources(folder), options)
    return evaluate_folder(folder, options)


def tune(*recordings: Recording, options: TuneOptions) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    with running("tune", options.json) as run:
        run.begin("reading")
        paths = (*recordings, *options.held_out)
        folders = prepared(paths, options.used)
        run.begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.tuning import tune_folders

        return tune_folders(folders, paths, options, run)


def sweep(*recordings: Recording, options: SweepOptions) -> int:
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
    """
    from trackwright.experiments.cli.console import keep_programs, prepared, running

    options.read()
    _ = options.grids
    with running("sweep", options.json) as run:
        run.begin("reading")
        folders = prepared(recordings, options.used, check=False)
        run.begin("preparing")
        keep_programs()
        from trackwright.experiments.cli.tuning import sweep_folders

        sweep_folders(folders, options, run)
    return 0
