"""Parts of a job: which are computed, in which order they come, what a bad one costs, and which workers are refused."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.experiments.jobs.deadly import Deadly
from tests.experiments.monte_carlo.small_study import TOML
from tests.in_process import assert_refused, trackwright
from trackwright.experiments.jobs.executors import Threads, cluster_executor, environment
from trackwright.experiments.jobs.store import Store, run
from trackwright.trackers.core.errors import UnusableInput


class Numbers(Store):
    """A number in a file for each part."""

    def __init__(self, folder):
        self.folder = folder

    def read(self, item):
        return int((self.folder / f"{item}.txt").read_text())

    def files(self, item, result):
        return {self.folder / f"{item}.txt": str(result)}


def _number(item):
    if item == 2:
        raise UnusableInput("two")
    return math.factorial(item)


def _found(items, store, executor, *failed):
    found = {}
    run(items, _number, store, executor, found.__setitem__, *failed)
    return found


@pytest.mark.parametrize("where", [Threads, lambda: Deadly(ThreadPoolExecutor(1), environment(), (6).__eq__)])
def test_what_the_store_lacks_is_computed_and_a_bad_part_costs_itself_alone(tmp_path, where):
    store = Numbers(tmp_path)
    store.keep(5, 55)
    with where() as executor:
        found = _found(iter(range(8)), store, executor, lambda item, error: -item)
        assert found == {0: 1, 1: 1, 2: -2, 3: 6, 4: 24, 5: 55, 6: -6 if where is not Threads else 720, 7: 5040}
        assert found == {item: store.kept(item) for item in range(8)}
        assert _found(range(8), store, None) == found


def test_a_part_that_fails_without_a_substitute_ends_the_run_and_what_has_finished_is_kept(tmp_path):
    store = Numbers(tmp_path)
    with Threads() as executor:
        _found([0, 1], store, executor)
        with pytest.raises(UnusableInput, match="two"):
            _found([2, 3], store, executor)
    assert (store.kept(0), store.kept(1), store.kept(2)) == (1, 1, None)


WAITS = """
from concurrent.futures import Future
import polars
from trackwright.experiments.jobs.store import finished
polars.LazyFrame({"a": [1]}).collect()
print("waits", flush=True)
list(finished(lambda item: Future(), [0]))
"""


def test_ctrl_c_ends_a_wait_for_a_part_that_never_ends():
    with subprocess.Popen([sys.executable, "-c", WAITS], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as waiting:
        assert waiting.stdout.readline() == b"waits\n"
        time.sleep(0.5)
        waiting.send_signal(signal.SIGINT)
        try:
            assert b"KeyboardInterrupt" in waiting.communicate(timeout=20)[1]
        finally:
            waiting.kill()


@pytest.mark.parametrize(
    ("cluster", "word"),
    [("local:0", "expected local:N, as local:4"), ("tcp://127.0.0.1:9", "no scheduler answers within")],
)
def test_a_cluster_that_is_none_is_refused_in_one_line(tmp_path, monkeypatch, cluster, word):
    pytest.importorskip("distributed")
    monkeypatch.setattr("trackwright.experiments.jobs.executors.CONNECT_S", 0.2)
    (tmp_path / "small.toml").write_text(TOML)
    said = trackwright("study", tmp_path / "small.toml", "--out", tmp_path / "out", "--cluster", cluster)
    assert said.code == 2
    assert f"--cluster {cluster}: {word}" in said.err.splitlines()[-1]


@pytest.mark.slow
def test_a_worker_with_another_version_is_refused_before_it_computes(tmp_path):
    distributed = pytest.importorskip("distributed")
    other = "from trackwright.experiments.jobs import executors\nexecutors.version = lambda name: '0.0.1'\n"
    (tmp_path / "small.toml").write_text(TOML)
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, preload=other, dashboard_address=":0") as started:
        on = ("--cluster", started.scheduler_address)
        with pytest.raises(UnusableInput, match="0.0.1"), cluster_executor(on[1]):
            pytest.fail("was connected")
        result = trackwright("study", tmp_path / "small.toml", "--out", tmp_path / "out", *on)
    assert_refused(result, "worker tcp://", "0.0.1", "expected as here: ")
    assert not [*(tmp_path / "out").glob("chunks/*")]
