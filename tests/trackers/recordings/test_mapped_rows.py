"""Rows in a file: the same numbers, none of them in this process's own memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.recordings.trajectories import mapped


def _arrays(recording):
    readings = [x for r in recording.readings.values() for x in (r.values, r.seen, r.reported) if x is not None]
    return [
        recording.times,
        *readings,
        *recording.inputs.values(),
        *(x for pair in recording.truth.values() for x in pair),
    ]


def _in_a_file(array):
    """Whether an array is a view of a mapped file."""
    while array is not None and not isinstance(array, np.memmap):
        array = array.base
    return array is not None


@pytest.fixture(scope="module")
def trajectories():
    folder = worlds.agv(n=3, seed=1, rows=40).folder()
    return list(build("fix-kf", folder).only_batch(folder).trajectories)


def test_mapped_rows_are_those_of_the_trajectories(trajectories, tmp_path):
    found = mapped(trajectories, tmp_path / "rows")
    for own, other in zip(trajectories, found, strict=True):
        assert (other.tag, other.station, other.recording.id) == (own.tag, own.station, own.recording.id)
        assert other.folder.name == own.folder.name
        assert not other.folder.tables
        pairs = list(zip(_arrays(own.recording), _arrays(other.recording), strict=True))
        assert len(pairs) >= 5
        for a, b in pairs:
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
            assert b.size == 0 or _in_a_file(b)
            assert not _in_a_file(a)


@pytest.mark.parametrize("rows", [40, 400])
def test_a_trajectory_takes_the_same_few_kilobytes_however_many_its_rows(rows, tmp_path):
    folder = worlds.agv(n=64, seed=1, rows=rows).folder()
    whole = list(build("fix-kf", folder).only_batch(folder).trajectories)
    mapped(whole[:1], tmp_path / "first")
    tracemalloc.start()
    found = mapped(whole, tmp_path / "rows")
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 4_000 * len(found)
