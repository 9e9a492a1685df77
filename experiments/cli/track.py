"""`trackwright track`; `tracking.py` and, for archives, `archive.py` do the work."""

from __future__ import annotations

from datetime import UTC, datetime

from trackwright.experiments.cli.options import Recording, TrackOptions


def track(*recordings: Recording, options: TrackOptions) -> int:
    """Track recordings: estimates, events, error metrics, a page with playback.

    Writes tracks.parquet, events.parquet, report.html, figures and manifest.json; prints error metrics where there is
    truth.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
    """
    started = datetime.now(UTC)
    from trackwright.experiments.cli.archives.folders import archive_of
    from trackwright.experiments.cli.console import json_alone, notice_other_calibration, prepared, usable_recordings
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.text.terminal import stages

    options.read()
    if options.tuned is not None:
        notice_other_calibration(options.noise, options.tuned.calibration, options.used.calibration)
    with json_alone(options.json) as put, stages("track") as begin:
        begin("reading")
        archive = archive_of(recordings, options.keep_going)
        if archive is None:
            usable, refused = usable_recordings(recordings, options.force, options.used.calibration is not None)
            folders = prepared(usable, options.used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.archive import track_archive
        from trackwright.experiments.cli.tracking import track_folders

        if archive is not None:
            return track_archive(archive, options, started, begin, put)
        return track_folders(folders, refused, options, started, begin, put)
