"""A study's folder: chunks in any order, damaged, of another study, written twice, on workers, after Ctrl-C."""

from __future__ import annotations

import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.experiments.monte_carlo.small_study import SMALL, TOML, sha
from trackwright.experiments.jobs.executors import WorkerExecutor, cluster_executor, environment
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.runner import ChunkStore, packed, packed_chunk, run_study
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.trackers.core.errors import UnusableInput


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a finished study, and the digest of its results."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    return folder, sha(run_study(SMALL, folder))


@pytest.fixture
def finished(whole, tmp_path):
    """A copy of that folder, and its chunks."""
    folder = tmp_path / "out"
    shutil.copytree(whole[0], folder)
    return folder, sorted((folder / "chunks").glob("*.npz"))


def test_chunks_in_another_order_give_the_same_numbers(whole, tmp_path):
    backwards = ChunkStore(tmp_path, SMALL).open()
    for part in ((c.index, k) for c in reversed(SMALL.conditions) for k in reversed(range(SMALL.chunks))):
        backwards.keep(part, packed_chunk(SMALL, part))
    assert sha(backwards.results()) == whole[1]


def test_chunks_cut_or_of_another_study_are_computed_again(whole, finished):
    folder, (_, cut, *others) = finished
    other, made = dataclasses.replace(SMALL, seed=1), {one: one.stat().st_mtime_ns for one in others}
    ChunkStore(folder, other).keep((0, 0), packed(run_chunk(other, other.conditions[0], np.arange(6), True)))
    before = cut.read_bytes()
    cut.write_bytes(before[: int(0.99 * len(before))])
    # What a killed process was writing is no chunk.
    (folder / "chunks" / ".trackwright-01234567-0000-000000.npz").write_bytes(b"half")
    assert sha(run_study(SMALL, folder)) == whole[1]
    assert len(cut.read_bytes()) > 0.9 * len(before)
    assert {one: one.stat().st_mtime_ns for one in others} == made


def test_a_damaged_chunk_is_named(finished):
    folder, (path, *_) = finished
    data = bytearray(path.read_bytes())
    data[90] ^= 255
    path.write_bytes(data)
    with pytest.raises(UnusableInput, match=f"{path.name}: no chunk of a study; remove it"):
        run_study(SMALL, folder)
    with pytest.raises(UnusableInput, match="holds another study .seed: 0, not 1"):
        run_study(dataclasses.replace(SMALL, seed=1), folder)


@pytest.mark.slow
def test_two_callers_on_one_folder_end_with_the_same_bits(whole, tmp_path):
    with ThreadPoolExecutor(2) as callers:
        found = [*callers.map(lambda _: run_study(SMALL, tmp_path), range(2))]
    assert [*map(sha, found)] == [whole[1]] * 2
    assert not [path.name for path in tmp_path.rglob(".*")]


PYTHON = """
import numpy as np
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.sim.worlds import WORLDS

STUDY = Study(
    name="mine", about="", worlds={"line": World(lambda ids, seed, **n: WORLDS["line"](ids, seed, rate_hz=1.0, **n))},
    trackers={"mine": TrackerConfig("mine.py:MINE"), "fix-kf": TrackerConfig("fix-kf")}, runs=12,
    measures={"last_m": lambda run: np.linalg.norm((run.estimates - run.truth)[:, -1, :2], axis=-1)},
    metrics=("rmse_m", "bound_m", "last_m"),
)
"""


@pytest.fixture
def studies(tmp_path, monkeypatch):
    """A study in Python with a world, a measure and a tracker of its own, and one in TOML."""
    (tmp_path / "mine.py").write_text("from trackwright.trackers.catalogue import spec_of\nMINE = spec_of('fix-kf')\n")
    (tmp_path / "study.py").write_text(PYTHON)
    (tmp_path / "small.toml").write_text(TOML + "[grid]\n'world.speed' = [0.2, 0.3]\n")
    monkeypatch.chdir(tmp_path)
    return [load_study("study.py"), load_study("small.toml")]


@pytest.fixture
def elsewhere():
    """An executor that pickles calls and checks its environment as workers do, in a thread of this process."""
    with ThreadPoolExecutor(1) as threads:
        yield WorkerExecutor(threads, environment())


@pytest.mark.slow
def test_a_study_on_workers_is_the_declared_one_with_the_bits_of_threads(studies, elsewhere, tmp_path):
    for study in studies:
        here = sha(run_study(study, tmp_path / "here" / study.name))
        assert sha(run_study(study, tmp_path / "there" / study.name, executor=elsewhere)) == here
    other = dataclasses.replace(studies[1], metrics=["bound_m"])
    with pytest.raises(UnusableInput, match="a worker has another declaration of small.toml"):
        run_study(other, tmp_path / "changed", executor=elsewhere)
    with pytest.raises(UnusableInput, match="built in memory"):
        run_study(SMALL, tmp_path / "memory", executor=elsewhere)


@pytest.mark.slow
def test_worker_processes_give_the_bits_of_threads(studies, tmp_path):
    pytest.importorskip("distributed")
    with cluster_executor("local:2") as workers:
        found = [sha(run_study(study, tmp_path / study.name, executor=workers)) for study in studies]
    assert found == [sha(run_study(study, tmp_path / f"{study.name}-here")) for study in studies]


@pytest.mark.parametrize("where", [pytest.param("threads", marks=pytest.mark.slow), "elsewhere"])
def test_a_study_interrupted_by_ctrl_c_continues_from_its_store(studies, elsewhere, tmp_path, where):
    study, seen = studies[1], []
    executor = None if where == "threads" else elsewhere

    def interrupted(done, now=""):
        seen.append(done)
        if sum(seen) >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path / "out", advance=interrupted, executor=executor)
    stored = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "chunks").glob("*.npz")}
    assert 2 <= len(stored) < len(study.conditions) * study.chunks
    assert sha(run_study(study, tmp_path / "out", executor=executor)) == sha(run_study(study, tmp_path / "whole"))
    assert {path: path.stat().st_mtime_ns for path in stored} == stored
