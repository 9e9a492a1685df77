"""`trackwright track`: its options; `tracking.py` does the work."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from experiments.cli.archives.folders import archive_of
from experiments.cli.arguments import FigureFormat, File, Folder, Folders
from experiments.cli.console import ReadingOptions, json_alone, notice_other_calibration, prepared, require_output
from experiments.cli.runtime import keep_programs
from experiments.cli.usable import usable_recordings
from experiments.text.terminal import stages
from trackers.core.errors import UnusableInput
from tuning.tuned_file import parse_values, read_tuned


def track(
    recordings: Folders,
    *,
    out: Folder,
    tracker: Annotated[str | None, "NAME"] = None,
    noise: File | None = None,
    set_: Annotated[tuple[str, ...], "NAME=VALUE"] = (),
    used: ReadingOptions,
    free_height: bool = False,
    smooth: bool = False,
    lag: Annotated[float | None, "S"] = None,
    seed: int = 0,
    cluster: Annotated[str | None, "ADDRESS"] = None,
    no_figures: bool = False,
    no_report: bool = False,
    format: FigureFormat = "png",
    force: bool = False,
    keep_going: bool = False,
    json: bool = False,
) -> int:
    """Track recordings: estimates, events, error metrics, a page with playback.

    Writes tracks.parquet, events.parquet, report.html, figures and manifest.json; prints error metrics where there is
    truth.

    Args:
        recordings: recording folders (rig.toml and tables), or folders of such folders.
        out: the folder to write to.
        tracker: one that `trackwright trackers` lists, or FILE.py:NAME of a TrackerSpec of your own; several names with
            commas are compared; default: that of the noise file, else for each recording the one that fits its tables.
        noise: a tuned.toml of `trackwright tune`.
        set_: values by tunable or pattern, e.g. sensors.ranges.sigma_r=0.1; those of `trackwright tunables`.
        free_height: estimate the height of tags whose height the rig gives.
        smooth: use later readings too, all of them: for recordings, where nothing has to be known at once.
        lag: smooth with the readings of the next so many seconds only.
        seed: of the random numbers of particle filters.
        cluster: track each recording by itself on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
        no_figures: draw no figures.
        no_report: write no report.html, the page with playback and linked charts.
        format: of the figures.
        force: track recordings in spite of the errors that `trackwright check` finds.
        keep_going: track each recording by itself, keep finished ones for the same command again, and leave out those
            that fail, with exit code 1; always with a folder of folders, and with more than 60 recordings.
        json: print the error metrics as JSON, by tracker, instead of tables.
    """
    started = datetime.now(UTC)
    require_output(out)
    if lag is not None and not 0 < lag < 1e6:
        raise UnusableInput(f"--lag {lag:g}: expected seconds above zero; leave it out to use the whole recording")
    values = parse_values(set_, "--set")
    tuned = None if noise is None else read_tuned(noise)
    if tuned is not None:
        notice_other_calibration(noise, tuned.calibration, used.calibration)
    with json_alone(json) as put, stages("track") as begin:
        begin("reading")
        archive = archive_of(recordings, keep_going)
        if archive is None:
            usable, refused = usable_recordings(recordings, force, used.calibration is not None)
            folders = prepared(usable, used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which the help and a refused recording need not wait for.
        from experiments.cli.archive import track_archive
        from experiments.cli.tracking import Options, track_folders

        options = Options(
            out, tracker, noise, tuned, values, used, free_height, smooth, lag, seed, cluster,
            not no_figures, not no_report, format,
        )  # fmt: skip
        if archive is not None:
            return track_archive(archive, force, options, started, begin, put)
        return track_folders(folders, refused, options, started, begin, put)
