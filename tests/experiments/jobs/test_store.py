"""Parts of a job: which are computed, in which order they come, and what a bad one costs."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event

import pytest

from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.executors import Threads, WorkerExecutor
from trackwright.experiments.jobs.store import Store, finished, run
from trackwright.trackers.core.errors import UnusableInput


class Numbers(Store):
    """A number in a file for each part."""

    def __init__(self, folder):
        self.folder = folder

    def read(self, item):
        return int((self.folder / f"{item}.txt").read_text())

    def files(self, item, result):
        return {self.folder / f"{item}.txt": str(result)}


class KilledWorker(Exception):  # noqa: N818 - the name in Dask
    """That of Dask."""


class Deadly(WorkerExecutor):
    """Workers, in threads, that the part of 6 ends."""

    def submit(self, function, *rest):
        if rest[-1] != 6:
            return super().submit(function, *rest)
        ended = Future()
        ended.set_exception(KilledWorker())
        return ended


def _number(item):
    if item == 2:
        raise UnusableInput("two")
    return math.factorial(item)


def _instead(item, error):
    return -item


def _unread(item):
    if item == 4:
        raise OSError("not there")
    return item


def _found(items, store, executor, *more):
    found = {}
    run(items, _number, store, executor, found.__setitem__, *more)
    return found


@pytest.mark.parametrize("where", [Threads, lambda: Deadly(ThreadPoolExecutor(1), environment())])
def test_what_the_store_lacks_is_computed_and_a_bad_part_costs_itself_alone(tmp_path, where):
    store = Numbers(tmp_path)
    store.keep(5, 55)
    with where() as executor:
        found = _found(iter(range(8)), store, executor, _unread, _instead)
        assert found == {0: 1, 1: 1, 2: -2, 3: 6, 4: -4, 5: 55, 6: -6 if where is not Threads else 720, 7: 5040}
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


def test_parts_that_have_not_begun_are_cancelled_where_one_fails():
    release, run = Event(), []

    def part(item):
        if item == 0:
            raise UnusableInput("the first part")
        release.wait(10)
        run.append(item)

    with ThreadPoolExecutor(1) as threads:
        with pytest.raises(UnusableInput, match="the first part"):
            list(finished(lambda item: threads.submit(part, item), range(5), at_once=5))
        release.set()
    assert len(run) <= 1
