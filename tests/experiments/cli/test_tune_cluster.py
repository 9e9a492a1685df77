"""`tune --cluster`: the files of a fit whose rows are all here, killed workers and Ctrl-C included."""

from __future__ import annotations

import dataclasses
import json

import pytest

from tests.held_here import client_here
from tests.in_process import trackwright
from trackwright.experiments.jobs import executors
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import write_recording
from trackwright.tuning import kept_fit
from trackwright.tuning.fitting import fit

FIT = (
    "--tracker",
    "fix-kf",
    "--tune",
    "motion.sigma_a",
    "sensors.*.sigma*",
    "--objective",
    "nll",
)


def _write(path, seed, **changed):
    folder = worlds.agv(n=2, seed=seed, rows=60).folder()
    rig = dataclasses.replace(folder.rig, name=path.name, **changed)
    write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
    return path


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Ten recordings of two vehicles each: more than a report of a cluster's fit shows."""
    return [_write(tmp_path_factory.mktemp("vehicles") / f"hall-{k}", k) for k in range(10)]


@pytest.fixture
def elsewhere(monkeypatch):
    """Clusters whose calls are made in this process."""
    monkeypatch.setattr(executors, "cluster_client", client_here)


def _both(tmp_path, *words):
    """The same fit on threads, to `a`, and on a cluster, to `b`."""
    run = ("tune", *words, *FIT)
    return [trackwright(*run, "--out", tmp_path / out, *on) for out, on in (("a", ()), ("b", ("--cluster", "x:1")))]


def _assert_same_files(tmp_path):
    for name in ("tuned.toml", "trace.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert sorted(x.name for x in (tmp_path / "a").iterdir()) == sorted(x.name for x in (tmp_path / "b").iterdir())


@pytest.mark.slow
def test_a_fit_on_a_cluster_writes_the_numbers_of_a_fit_here(paths, elsewhere, tmp_path):
    words = (*paths[:2], "--held-out", paths[2], "--steps", 1, "--starts", 2, "--piece-rows", 30, "--figures", "none")
    here, there = _both(tmp_path, *words)
    assert (here.code, there.code) == (0, 0), there.err
    _assert_same_files(tmp_path)
    assert here.out.replace(str(tmp_path / "a"), "") == there.out.replace(str(tmp_path / "b"), "")
    assert json.loads((tmp_path / "b" / "manifest.json").read_text())["config"]["cluster"] == "x:1"


@pytest.mark.slow
def test_a_fit_interrupted_on_a_cluster_is_resumed_with_the_same_bits_there_or_here(
    paths, elsewhere, tmp_path, monkeypatch
):
    run = ("tune", *paths[:2], *FIT, "--steps", 2, "--starts", 1, "--figures", "none")
    assert trackwright(*run, "--out", tmp_path / "whole").code == 0

    def interrupted(*arguments):
        *others, place = arguments

        def report(state):
            place.report(state)
            if int(state.number) == 1:
                raise KeyboardInterrupt

        return fit(*others, dataclasses.replace(place, report=report))

    for again in ("--cluster", "x:1"), ():
        out = ("--out", tmp_path / f"again-{len(again)}")
        with monkeypatch.context() as patched:
            patched.setattr(kept_fit, "fit", interrupted)
            assert trackwright(*run, *out, "--cluster", "x:1").code == 130
        assert trackwright(*run, *out, *again, "--resume").code == 0
        for name in ("tuned.toml", "trace.csv"):
            assert (out[1] / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
