"""`trackwright sweep`; `sweep_job.py` does the work."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from trackwright.experiments.cli.options import Recording, SweepOptions

if TYPE_CHECKING:
    pass


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
