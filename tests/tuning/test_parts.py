"""The rows of a fit elsewhere, or stacked piece by piece: the bits of a fit that has them all in this process."""

from __future__ import annotations

import dataclasses
import pickle

import jax
import numpy as np
import pytest

from tests.tuning.worlds import line_tracker, walks
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.recordings.tracks import batches
from trackwright.tuning.batches import Pieces, lengths_of
from trackwright.tuning.checkpoint import fingerprint
from trackwright.tuning.data import fit_data
from trackwright.tuning.fitting import FitOptions, Place, fit
from trackwright.tuning.guessing import sample_segments
from trackwright.tuning.objectives import NegativeLogLikelihood, RootMeanSquareError
from trackwright.tuning.optimisers import Adam
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.parts import Computation, LocalParts, Parts, on_chunk
from trackwright.tuning.problem import Problem

LEVELS = ("motion.sigma_v", "sensors.gauge.sigma")


class Elsewhere(Parts):
    """The parts of a problem as other processes have them: all that travels is pickled, the last chunk comes first."""

    def __init__(self, point, pieces):
        every = list(pieces)
        self.rows, self.held = [lengths_of(piece) for piece in every], [pickle.dumps((point, one)) for one in every]

    def compute(self, computation):
        call = pickle.dumps(computation)
        found = [on_chunk(*pickle.loads(held), pickle.loads(call)) for held in reversed(self.held)]
        return [pickle.loads(pickle.dumps(one)) for one in reversed(found)]


LIKELIHOOD, ERROR = NegativeLogLikelihood(), RootMeanSquareError(dimensions=1)
FITS = {
    "two chunks, many in each": (walks([30] * 20, 1), LIKELIHOOD, {"chunk": 16}),
    "few": (walks([40, 25, 40], 2), LIKELIHOOD, {}),
    "others held out": (walks([30] * 30, 3), ERROR, {"optimiser": Adam(3), "held_out": walks([30] * 10, 4)}),
}


@pytest.mark.parametrize("name", FITS)
def test_a_fit_has_the_same_bits_wherever_its_rows_are(name):
    recordings, objective, options = FITS[name]
    here, there = (
        fit(line_tracker(sigma=0.4), recordings, objective, LEVELS, FitOptions(steps=3, **options), Place(keep=keep))
        for keep in (LocalParts, Elsewhere)
    )
    assert there.problem.parts.held
    assert not np.array_equal(here.vector, here.start_vector)
    for mine, other in zip(*(_numbers(result) for result in (here, there)), strict=True):
        np.testing.assert_array_equal(mine, other)
    assert there.cautions == here.cautions
    assert there.filter_runs == here.filter_runs


def _numbers(result):
    yield from (result.vector, result.value, result.start_value, result.evaluation.term_gradients)
    yield from (result.uncertainty.sigmas, result.uncertainty.optimum.hessian, result.uncertainty.optimum.influence)
    yield from ([step.value for step in steps] for steps in result.starts)


def test_random_numbers_are_those_of_the_same_realisation_wherever_the_rows_are():
    tracker = line_tracker()
    parameters = select_parameters(tracker, LEVELS)
    here, there = (
        Problem(tracker, [stack(walks([5] * 6, 2))], LIKELIHOOD, parameters, 4, keep=keep).parts
        for keep in (LocalParts, Elsewhere)
    )
    blocks = [flatten(parameters)[None]]
    drawn = [[parts.compute(Computation(_keys, blocks, _as_found, k)) for parts in (here, there)] for k in (0, 3)]
    for mine, other in drawn:
        np.testing.assert_array_equal(mine, other)
    assert not np.array_equal(drawn[0][0], drawn[1][0])


def _keys(point, batch):
    return batch.key


def _as_found(found, chunk):
    return found


@pytest.fixture(scope="module")
def data():
    """Segments of nine vehicles in two recordings, of different lengths."""
    folders = [worlds.agv(n=n, seed=n, rows=rows).folder() for n, rows in ((5, 90), (4, 60))]
    named = build("fix-kf", folders)
    return fit_data(named.only_batch(folders), "state-nll", segment_rows=25)


@pytest.mark.parametrize(
    ("largest", "long"), [(4096, 1000), (5, 1000), (5, 10)], ids=["one batch", "several", "one by one"]
)
@pytest.mark.parametrize("chunk", [512, 3])
def test_rows_stacked_piece_by_piece_are_those_of_whole_batches(data, monkeypatch, chunk, largest, long):
    monkeypatch.setattr("trackwright.trackers.recordings.tracks.MAX_BATCH", largest)
    monkeypatch.setattr("trackwright.trackers.core.run.chunks.LONG", long)
    whole, lazy = (dataclasses.replace(data, stacked=stacked) for stacked in (True, False))
    pairs = list(zip(*(Pieces(own.batches(), chunk) for own in (whole, lazy)), strict=True))
    assert len(pairs) > 1 or chunk == 512
    for piece, other in pairs:
        _assert_equal(piece, other)
    for mine, other in zip(whole.weights(), lazy.weights(), strict=True):
        np.testing.assert_array_equal(mine, other)
    names = [[t.folder.name for t in own] for own, _ in batches(whole.training)]
    assert whole.recordings() == lazy.recordings() == names
    _assert_equal(*(sample_segments(own.batches(), 4) for own in (whole, lazy)))
    marks = {fingerprint({"a": 1}, own.batches(), np.zeros(2)) for own in (whole, lazy)}
    assert len(marks) == 1


def _assert_equal(mine, other):
    for a, b in zip(*(jax.tree_util.tree_leaves(tree) for tree in (mine, other)), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_a_checkpoint_tells_recordings_that_differ_in_one_number_apart(data):
    last = data.training[-1]
    readings = {
        name: dataclasses.replace(r, values=np.append(r.values[:-1], r.values[-1:] + 1e-3, axis=0))
        for name, r in last.recording.readings.items()
    }
    changed = dataclasses.replace(last, recording=dataclasses.replace(last.recording, readings=readings))
    other = dataclasses.replace(data, training=[*data.training[:-1], changed])
    assert len({fingerprint({}, own.batches(), np.zeros(2)) for own in (data, other)}) == 2
