"""The chunks of a fit with workers: the bits of those held here, what travels, and what is refused."""

from __future__ import annotations

import dataclasses
import os
import pickle
import signal
import sys

import numpy as np
import pytest

from tests.catalogue import CASES
from tests.held_here import Client
from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.executors import cluster_client
from trackwright.experiments.jobs.held_parts import FitWorkers, HeldParts
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.tuning.batches import Pieces
from trackwright.tuning.data import fit_data
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.parts import Computation, LocalParts
from trackwright.tuning.problem import Problem

MINE = """
import dataclasses
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.model.motion import GroundMotion

class Mine(GroundMotion):
    pass

def built(trajectory, planar):
    return dataclasses.replace(spec_of("fix-kf").build(trajectory, planar), motion=Mine(0.5, 0.3))

MINE = dataclasses.replace(spec_of("fix-kf"), build=built)
"""


@pytest.fixture
def vehicles():
    folder = worlds.agv(n=12, seed=3, rows=40).folder()
    named = build("fix-kf", folder)
    return named, fit_data(named.only_batch(folder), "nll")


def _problem(named, data, place):
    return Problem(
        data.tracker, data.batches(), data.objective, select_parameters(named.tracker, ["motion.*"]), keep=place
    )


def _workers(folder):
    return FitWorkers(Client(), environment(), folder)


def test_evaluations_on_workers_have_the_bits_of_those_here_and_send_only_what_is_of_trajectories(vehicles, tmp_path):
    named, data = vehicles
    workers = _workers(tmp_path)
    lazy = dataclasses.replace(data, stacked=False)
    here = _problem(named, data, LocalParts)
    there = _problem(named, lazy, lambda point, pieces: HeldParts(workers, named, point, pieces))
    vector = flatten(here.parameters)
    mine, other = here.evaluate(vector), there.evaluate(vector)
    for name in ("values", "gradients", "terms", "term_gradients"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name))
    numbers = sum(x.size for chunk in workers.client.results for found in chunk for x in found)
    assert numbers == mine.terms.size + mine.term_gradients.size
    assert numbers < sum(np.size(x) for x in data.rows()[0].readings["fixes"]) / 10


@pytest.mark.slow
def test_chunks_whose_worker_is_killed_are_loaded_by_others(vehicles, tmp_path):
    pytest.importorskip("distributed")
    named, data = vehicles
    here = _problem(named, data, LocalParts)
    pieces = Pieces(data.batches(), 2)
    keys = Computation(_keys, [flatten(here.parameters)[None]], _as_found)
    with cluster_client("local:2") as (client, expected):
        parts = HeldParts(FitWorkers(client, expected, tmp_path), named, here.start, pieces)
        before = parts.compute(keys)
        pids = list(client.run(os.getpid).values())
        assert len(pids) == 2
        os.kill(pids[0], signal.SIGKILL)
        after = parts.compute(keys)
    expected_keys = LocalParts(here.start, pieces).compute(keys)
    assert len(expected_keys) == 6
    np.testing.assert_array_equal(before, expected_keys)
    np.testing.assert_array_equal(after, expected_keys)


def _keys(point, batch):
    return batch.key


def _as_found(found, chunk):
    return found


def test_a_tracker_of_a_user_s_file_travels_with_the_file(vehicles, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(MINE)
    folder = vehicles[1].training[0].folder
    named = build(f"{tmp_path / 'mine.py'}:MINE", folder)
    data = fit_data(named.only_batch(folder), "nll")
    here = _problem(named, data, LocalParts)
    there = _problem(named, data, lambda point, pieces: HeldParts(_workers(tmp_path), named, point, pieces))
    assert type(here.tracker.motion).__module__ == "trackwright_tracker_mine"
    # A worker has not imported the file.
    monkeypatch.delitem(sys.modules, "trackwright_tracker_mine")
    vector = flatten(here.parameters)
    np.testing.assert_array_equal(there.terms(vector), here.terms(vector))


def test_every_tracker_can_travel():
    for case in CASES.values():
        tracker = case.tracker()
        assert type(pickle.loads(pickle.dumps(tracker))) is type(tracker)
