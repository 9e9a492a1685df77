"""A fit whose rows a cluster holds: recordings are read one at a time, and only what is looked at is in memory here."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from experiments.cli.console import output_folder
from experiments.jobs.executors import cluster_client
from experiments.jobs.held_parts import FitWorkers
from experiments.pages.reports.tracks_compared import MOST_PLANS
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackers.recordings.mapped_rows import mapped
from trackers.recordings.named_tracker import NamedTracker
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.trajectories import Trajectory
from tuning.data import FitData, fit_segments, judged_dimensions, segments_data
from tuning.weights import Weigh

PARTS = ".tune-parts"
"""The folder of the rows, in that of the results, while the command runs."""


@contextmanager
def fit_workers(cluster: str | None, out: Path) -> Iterator[FitWorkers | None]:
    """The workers of a cluster, as of `cluster_client`, with the folder of their files; None for no cluster.

    What an earlier command that was killed left in that folder is removed.
    """
    if cluster is None:
        yield None
        return
    folder = output_folder(out) / PARTS
    shutil.rmtree(folder, ignore_errors=True)
    try:
        with cluster_client(cluster) as (client, expected):
            yield FitWorkers(client, expected, output_folder(folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):
            out.rmdir()  # if nothing was written


def data_in_turn(
    named: NamedTracker,
    folders: Sequence[RecordingFolder],
    count: int,
    place: Path,
    objective: str | None,
    segment_rows: int,
    dimensions: int | None,
    weigh: Weigh,
) -> FitData:
    """As `fit_data` of the first `count` recordings, the others held out; the rows are in files in the folder `place`.

    `dimensions`: None for those of the first recording. Raises UnusableInput as `fit_data`, and where the recordings
    need several trackers.
    """
    names, trajectories = list[str](), list[Trajectory]()
    batch: TrackerBatch | None = None

    def each() -> Iterator[RecordingFolder]:
        for folder in folders:
            names.append(folder.name)
            yield folder

    for batch in named.batch_by_batch(each()):
        dimensions = dimensions or judged_dimensions(batch, objective)
        own = fit_segments(batch, segment_rows, dimensions)
        trajectories += mapped(own, place / f"rows-{len(names)}")
    refuse_same_names(names)
    if batch is None:
        raise UnusableInput(f"tracker '{named.name}': no trajectory in the recordings; expected one tag at least")
    every = replace(batch, tracker=named.tracker, trajectories=trajectories)
    return segments_data(every, objective, set(names[count:]), dimensions or 2, weigh, stacked=False)


def reported(data: FitData) -> FitData:
    """The data of at most `MOST_PLANS` recordings tuned on, and of all held out: what a report is made of here."""
    names = list(dict.fromkeys(trajectory.folder.name for trajectory in data.training))[:MOST_PLANS]
    return replace(data, training=[own for own in data.training if own.folder.name in names], stacked=True)
