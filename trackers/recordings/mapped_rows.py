"""Trajectories whose rows are in a file: the system reads what is looked at, and needs no memory for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.recordings.atomic import atomic_write
from trackwright.trackers.recordings.trajectories import Trajectory

ALIGNMENT = 64
"""Bytes that each array begins at a multiple of."""


def mapped(trajectories: Sequence[Trajectory], path: Path) -> list[Trajectory]:
    """Trajectories of one recording with their rows in the file `path`, which is written; its tables are left out.

    Raises UnusableInput for a full disk.
    """
    begins: list[int] = []

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:

            def put(array: np.ndarray) -> np.ndarray:
                file.write(bytes(-file.tell() % ALIGNMENT))
                begins.append(file.tell())
                file.write(array.tobytes())
                return array

            for trajectory in trajectories:
                _with_arrays(trajectory.recording, put)

    atomic_write(path, write)
    # Plain views: a memmap of each array would take more memory than its place in the file.
    content, places = np.memmap(path, np.uint8, "r").view(np.ndarray), iter(begins)

    def get(array: np.ndarray) -> np.ndarray:
        begin = next(places)
        return content[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)

    folder = replace(trajectories[0].folder, tables={})
    return [replace(own, folder=folder, recording=_with_arrays(own.recording, get)) for own in trajectories]


def _with_arrays(recording: Recording, function: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The recording with `function` of each of its arrays, in an order of their own."""
    readings = {
        name: Readings(function(r.values), function(r.seen), None if r.reported is None else function(r.reported))
        for name, r in recording.readings.items()
    }
    inputs = {name: function(x) for name, x in recording.inputs.items()}
    truth = {name: (function(values), function(known)) for name, (values, known) in recording.truth.items()}
    return replace(recording, times=function(recording.times), readings=readings, inputs=inputs, truth=truth)
