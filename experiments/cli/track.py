"""`trackwright track`: its options; `tracking.py` does the work."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import read_with_notices
from experiments.cli.runtime import keep_programs
from experiments.cli.summaries import COMMANDS, TRACKERS


def track(  # noqa: D103
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    tracker: str | None = None,
    noise: Path | None = None,
    calibration: Path | None = None,
    average: float | None = None,
    free_height: bool = False,
    smooth: bool = False,
    lag: float | None = None,
    seed: int = 0,
    cluster: str | None = None,
) -> int:
    started = datetime.now(UTC)
    folders = read_with_notices(recordings, calibration, average)
    keep_programs()
    # jax takes a second to import, which the help and a refused recording need not wait for.
    from experiments.cli.tracking import Options, track_folders

    options = Options(recordings, out, tracker, noise, calibration, average, free_height, smooth, lag, seed, cluster)
    return track_folders(folders, options, started)


_LIST = "\n".join(f"    {name}: {about}" for name, about in TRACKERS.items())
track.__doc__ = f"""{COMMANDS["track"]}

Trackers (and the table they read):
{_LIST}

Args:
    recordings: recording folders (rig.toml and tables).
    out: the folder to write to.
    tracker: one of the names above, or FILE.py:NAME of a TrackerSpec of your own; default: what fits the tables.
    noise: a tuned.toml of `trackwright tune`.
    calibration: a calibration.toml of `trackwright calibrate` on other recordings of these stations or anchors.
    average: average the ranges, fixes and bearings of each tag and anchor or station over so many seconds;
    0: every reading; default: 0.5 for bearings that repeat.
    free_height: estimate the height of tags whose height the rig gives.
    smooth: use the rows after each row too, all of them: for recordings, where nothing has to be known at once.
    lag: smooth with the rows of the next so many seconds only.
    seed: of the random numbers of particle filters; another one gives other estimates of the same distribution.
    cluster: track each recording by itself on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
"""
