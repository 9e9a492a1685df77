"""Checkpoints of fits tell recordings apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.tuning.checkpoint import fingerprint
from trackwright.tuning.data import fit_data


@pytest.fixture(scope="module")
def data():
    """Segments of nine vehicles in two recordings, of different lengths."""
    folders = [worlds.agv(n=n, seed=n, rows=rows).folder() for n, rows in ((5, 90), (4, 60))]
    named = build("fix-kf", folders)
    return fit_data(named.only_batch(folders), "state-nll", segment_rows=25)


def test_a_checkpoint_tells_recordings_that_differ_in_one_number_apart(data):
    last = data.training[-1]
    readings = {
        name: dataclasses.replace(r, values=np.append(r.values[:-1], r.values[-1:] + 1e-3, axis=0))
        for name, r in last.recording.readings.items()
    }
    changed = dataclasses.replace(last, recording=dataclasses.replace(last.recording, readings=readings))
    other = dataclasses.replace(data, training=[*data.training[:-1], changed])
    assert len({fingerprint({}, own.batches(), np.zeros(2)) for own in (data, other)}) == 2
