"""`trackwright tune` and `sweep`; `tuning_job.py`, `tuning_folder.py` and `sweep_job.py` do the work."""

from __future__ import annotations

import time
from datetime import UTC, datetime

from trackwright.experiments.cli.options import Recording, SweepOptions, TuneOptions


def tune(*recordings: Recording, options: TuneOptions) -> int:
    """Fit noise levels by gradient: values, intervals and a report.

    Writes tuned.toml, for `--noise` of `track`, report.html, trace.csv and a checkpoint. Other tunables than noise
    levels are fitted where --tune names them.

    Args:
        recordings: recording folders to fit to, all at once.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    from trackwright.experiments.cli.console import FoldersInTurn, checked, json_alone, prepared
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.text.terminal import stages
    from trackwright.trackers.recordings.folder import read_recordings

    options.read()
    with json_alone(options.json) as put, stages("tune") as begin:
        begin("reading")
        paths, used = (*recordings, *options.held_out), options.used
        folders = (
            prepared(checked(read_recordings(paths), None, used.calibration is not None), used)
            if options.cluster is None
            else FoldersInTurn(paths, used)
        )
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.tuning_folder import tune_folders

        code, content = tune_folders(folders, recordings, options, started, clock, begin)
        put(content)
    return code


def sweep(*recordings: Recording, options: SweepOptions) -> int:
    """Evaluate an objective on a grid of one or two noise levels.

    Writes sweep.csv, the figure sweep.png and manifest.json.

    Args:
        recordings: recording folders, all at once.
    """
    started, clock = datetime.now(UTC), time.perf_counter()
    from trackwright.experiments.cli.console import json_alone, read_with_notices
    from trackwright.experiments.cli.runtime import keep_programs
    from trackwright.experiments.text.terminal import stages

    options.read()
    _ = options.grids
    with json_alone(options.json) as put, stages("sweep") as begin:
        begin("reading")
        folders = read_with_notices(recordings, options.used)
        begin("preparing")
        keep_programs()
        # jax takes a second to import, which a refused recording need not wait for.
        from trackwright.experiments.cli.sweep_job import sweep_folders

        put(sweep_folders(folders, recordings, options, started, clock, begin))
    return 0
