"""`trackwright track` and `evaluate`; `tracking.py`, `evaluating.py` and, for archives, `archive.py` do the work."""

from __future__ import annotations

from datetime import UTC, datetime

from trackwright.experiments.cli.options import EvaluateOptions, PoseOptions, Recording, TrackOptions
from trackwright.trackers.core.errors import UnusableInput


def track(*recordings: Recording, options: TrackOptions) -> int:
    """Track recordings: estimates, events, error metrics, a page with playback.

    Writes tracks.parquet, events.parquet, report.html and manifest.json; prints error metrics where there is
    truth.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
    """
    started = datetime.now(UTC)
    from trackwright.experiments.cli.archive_folders import archive_of
    from trackwright.experiments.cli.console import json_alone, notice_other_calibration, prepared, usable_recordings
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.text.terminal import stages

    options.read()
    if options.tuned is not None:
        notice_other_calibration(options.noise, options.tuned, options.used.calibration)
    with json_alone(options.json) as put, stages("track") as begin:
        begin("reading")
        archive = archive_of(recordings, options.keep_going or options.cluster is not None)
        if archive is None:
            usable, refused = usable_recordings(recordings, options.force, options.used.calibration is not None)
            folders = prepared(usable, options.used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        if archive is not None:
            from trackwright.experiments.cli.archive import track_archive

            return track_archive(archive, options, started, begin, put)
        from trackwright.experiments.cli.tracking import track_folders

        return track_folders(folders, refused, options, started, begin, put)


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
    if len(runs) > 1:
        out = options.poses.out
        if options != EvaluateOptions(json=options.json, poses=PoseOptions(out=out)):
            raise UnusableInput(f"evaluate: {len(runs)} runs to compare; expected no option but --json and --out")
        from trackwright.experiments.cli.evaluating import print_comparison

        print_comparison(runs, out, json=options.json)
        return 0
    (folder,) = runs
    poses, truth = options.poses, options.truth
    if not folder.exists():
        raise UnusableInput(f"{folder}: no such file; expected a folder with tracks.parquet, or a file of estimates")
    from trackwright.experiments.cli.archive_folders import RECORDINGS, is_archive
    from trackwright.experiments.cli.evaluating import evaluate_folder, evaluate_poses, sources
    from trackwright.trackers.recordings.tracks_table import TRACKS

    if is_archive(folder):
        if poses.given or truth:
            fix = f"expected no --truth and trajectory options; evaluate one of {folder / RECORDINGS}/*/*"
            raise UnusableInput(f"{folder}: is an archive; {fix}")
        # jax takes a second to import, which the help and a refused folder need not wait for.
        from trackwright.experiments.cli.archive import evaluate_archive

        return evaluate_archive(folder, options)
    if (folder / RECORDINGS).is_dir() and not (folder / TRACKS).exists():
        raise UnusableInput(f"{folder}: an archive that was not tracked to its end; run the same `track` again")
    if options.cluster is not None:
        raise UnusableInput(f"--cluster {options.cluster}: {folder} is no archive; leave --cluster out")
    if folder.is_file() or poses.given or not all(path.is_dir() for path in truth):
        known = truth if truth or folder.is_file() else sources(folder)
        return evaluate_poses(folder, known, options)
    return evaluate_folder(folder, options)
