"""Parts of a command on workers: what they return, in which order, and which workers are refused."""

from __future__ import annotations

import pytest

from tests.experiments.monte_carlo.small_study import TOML
from tests.in_process import assert_refused, trackwright
from trackwright.experiments.jobs.executors import cluster_executor
from trackwright.trackers.core.errors import UnusableInput


@pytest.mark.parametrize(
    ("cluster", "words"),
    [
        ("local:0", ("--cluster local:0", "local:4", "tcp://HOST:8786")),
        ("four", ("--cluster four",)),
        ("tcp://127.0.0.1:9", ("no scheduler answers", "dask scheduler")),
    ],
)
def test_a_cluster_that_is_none_is_refused_in_one_line(tmp_path, monkeypatch, cluster, words):
    pytest.importorskip("distributed")
    monkeypatch.setattr("trackwright.experiments.jobs.executors.CONNECT_S", 0.2)
    file = tmp_path / "small.toml"
    file.write_text(TOML)
    result = trackwright("study", file, "--out", tmp_path / "out", "--cluster", cluster)
    assert result.code == 2
    for word in words:
        assert word in result.err.splitlines()[-1]


def test_a_worker_with_another_version_is_refused_before_it_computes(tmp_path):
    distributed = pytest.importorskip("distributed")
    other = "from trackwright.experiments.jobs import environment\nenvironment._version = lambda name: '0.0.1'\n"
    file = tmp_path / "small.toml"
    file.write_text(TOML)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, preload=other, dashboard_address=":0") as started:
        address = started.scheduler_address
        with pytest.raises(UnusableInput, match="trackwright: 0.0.1"), cluster_executor(address):
            pytest.fail("was connected")
        result = trackwright("study", file, "--out", tmp_path / "out", "--cluster", address)
    assert_refused(result, "worker tcp://", "trackwright: 0.0.1", "expected as here: ")
    assert not [*(tmp_path / "out").glob("chunks/*")]
