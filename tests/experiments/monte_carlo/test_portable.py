"""Studies in other processes: the same declaration, the same bits, and a store that stays with the caller."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.experiments.monte_carlo.small_study import TOML, sha
from trackwright.experiments.jobs.environment import environment
from trackwright.experiments.jobs.executors import WorkerExecutor, cluster_executor
from trackwright.experiments.monte_carlo.runner import StopRule, run_study
from trackwright.experiments.monte_carlo.sources import PortableStudy, available_studies, load_study

MINE = "from trackwright.trackers.catalogue import spec_of\n\nMINE = spec_of('fix-kf')\n"
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study in Python with a world, a measure and a tracker of its own, and one in TOML; in a folder of their own."""
    folder = tmp_path_factory.mktemp("declared")
    (folder / "mine.py").write_text(MINE)
    (folder / "study.py").write_text(PYTHON)
    (folder / "small.toml").write_text(TOML + "[grid]\n'world.speed' = [0.2, 0.3]\n")
    return folder


@pytest.fixture
def studies(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return [load_study("study.py"), load_study("small.toml")]


@pytest.fixture(scope="module")
def shas(folder, tmp_path_factory):
    """Digests of both studies' results on threads."""
    out = tmp_path_factory.mktemp("threads")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return [sha(run_study(load_study(name), out / name)) for name in ("study.py", "small.toml")]


@pytest.fixture
def elsewhere():
    """An executor that pickles calls and checks its environment as workers do, in a thread of this process."""
    with ThreadPoolExecutor(1) as threads:
        yield WorkerExecutor(threads, environment())


def test_a_study_is_built_again_from_text_and_numbers_far_from_its_files(studies, monkeypatch, tmp_path):
    portable = PortableStudy.of(dataclasses.replace(studies[0], runs=7, seed=3))
    monkeypatch.chdir(tmp_path)
    again = portable.study()
    assert (again.name, again.runs, again.seed, again.source) == ("mine", 7, 3, PYTHON)
    assert again.trackers["mine"].spec.table == "fixes"


@pytest.mark.parametrize("name", available_studies())
def test_every_name_on_the_list_is_a_study_with_expected_results(name):
    study = load_study(name)
    assert study.name == name
    assert study.expected is not None


@pytest.mark.slow
def test_worker_processes_give_the_bits_of_threads(studies, shas, tmp_path):
    pytest.importorskip("distributed")
    with cluster_executor("local:2") as workers:
        found = [sha(run_study(study, tmp_path / study.name, executor=workers)) for study in studies]
    assert found == shas


@pytest.mark.slow
def test_a_condition_ends_early_elsewhere_as_on_threads(studies, elsewhere, tmp_path):
    study = studies[1]
    stop = StopRule.parse("rmse_m±90%", study)
    here, there = (run_study(study, tmp_path / f"{x is None}", until=stop, executor=x) for x in (None, elsewhere))
    assert there.runs == here.runs
    assert min(there.runs.values()) < study.runs
    assert sha(there) == sha(here)


@pytest.mark.parametrize("where", ["threads", "elsewhere"])
def test_a_study_interrupted_by_ctrl_c_continues_from_its_store(studies, shas, elsewhere, tmp_path, where):
    study, seen = studies[1], []
    executor = None if where == "threads" else elsewhere

    def interrupted(done, now=""):
        seen.append(done)
        if sum(seen) >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path, advance=interrupted, executor=executor)
    stored = {path: path.stat().st_mtime_ns for path in (tmp_path / "chunks").glob("*.npz")}
    assert 2 <= len(stored) < len(study.conditions) * study.chunks
    assert sha(run_study(study, tmp_path, executor=executor)) == shas[1]
    assert {path: path.stat().st_mtime_ns for path in stored} == stored
