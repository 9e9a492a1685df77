"""Recordings of a batch tracked and scored one by one elsewhere: the bits of each alone."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import polars as pl
import pytest

from tests.in_process import trackwright
from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.executors import WorkerExecutor
from trackwright.experiments.jobs.portable import run_on
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.folder import read_recordings

MINE = "from trackwright.trackers.catalogue import spec_of\n\nMINE = spec_of('fix-kf')\n"


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("vehicles")
    for k in range(2):
        words = ("simulate", "agv", "--n", 2, "--rows", 40, "--seed", k, "--out", folder / f"agv-{k}")
        assert trackwright(*words).code == 0
    return [folder / f"agv-{k}" for k in (0, 1)]


@pytest.fixture
def elsewhere():
    """An executor that pickles calls and checks its environment as workers do, in a thread of this process."""
    with ThreadPoolExecutor(1) as threads:
        yield WorkerExecutor(threads, environment())


@pytest.mark.parametrize("kind", ["values", "smoothed", "file"])
def test_each_recording_is_tracked_as_if_alone(paths, elsewhere, kind, tmp_path, monkeypatch):
    folders = read_recordings(paths)
    (tmp_path / "mine.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    tracker = build("mine.py:MINE" if kind == "file" else "fix-kf", folders).with_values({"motion.sigma_a": 0.3})
    if kind == "smoothed":
        tracker = tracker.smoothing(2.0)
    steps = []
    found = run_on(elsewhere, tracker, folders, steps.append)
    alone = [tracker.run(folder) for folder in folders]
    assert found.table.equals(pl.concat([one.table for one in alone], how="diagonal").sort("recording", "tag", "t_s"))
    assert found.summaries == {"ok": 4}
    assert steps == [2, 2]


def test_metrics_of_recordings_scored_one_by_one_are_those_of_all_at_once(paths, elsewhere):
    folders = read_recordings(paths)
    table = build("fix-kf", folders).run(folders).table.sample(fraction=1.0, shuffle=True, seed=1)
    for every in (None, 0.5):
        assert evaluate(table, folders, every, elsewhere) == evaluate(table, folders, every)


def test_bearings_of_recordings_scored_one_by_one_have_the_same_metrics(elsewhere):
    folders = [dataclasses.replace(worlds.station(n=1, seed=k, rows=20).folder(), name=f"r{k}") for k in range(2)]
    truth = folders[0].tables["truth"]
    count, rng = len(truth), np.random.default_rng(4)
    columns = ("azimuth_rad", "elevation_rad", "std_azimuth_rad", "std_elevation_rad")
    tables = [
        pl.DataFrame({"recording": [f.name] * count, "tag": truth["tag"], "station": [station] * count})
        .with_columns(t_s=truth["t_s"], nis=pl.lit(1.5), nis_dof=pl.lit(2.0), status=pl.lit("ok"))
        .with_columns(**{name: rng.uniform(0.1, 0.3, count) for name in columns})
        for f in folders
        for station in f.rig.stations
    ]
    table = pl.concat(tables)
    assert evaluate(table, folders, None, elsewhere) == evaluate(table, folders)
