"""Commands on a scheduler of one's own: `dask scheduler` and `dask worker` as processes, and a scheduler that dies."""

from __future__ import annotations

import os
import signal
import time

import pytest

from tests.faults.jobs import begun, half_written, jobs, reference, run, running, temporary
from tests.faults.seen import Seen
from tests.faults.workers import dask_cluster, dask_scheduler, dask_workers
from tests.in_process import trackwright
from trackwright.experiments.jobs.executors import GONE_S

pytest.importorskip("distributed")


@pytest.mark.slow
def test_a_scheduler_with_two_workers_gives_the_bits_of_threads(tmp_path):
    # A track of few recordings is that of an archive on a cluster.
    all_jobs = {name: job for name, job in jobs(tmp_path).items() if name != "track"}
    with dask_cluster(tmp_path) as (address, _):
        for name, job in all_jobs.items():
            here, there = tmp_path / f"{name}-here", tmp_path / f"{name}-there"
            assert run(job.line(here)).code == 0
            ended = run(job.line(there, "--cluster", address))
            assert ended.code == 0, ended.err
            assert job.digest(there) == job.digest(here)
        scored = [
            trackwright("evaluate", tmp_path / "archive-there", "--json", *on) for on in ((), ("--cluster", address))
        ]
        assert scored[0] == scored[1]


@pytest.mark.slow
def test_a_fit_whose_scheduler_is_killed_is_refused_in_a_line_and_goes_on_with_threads(tmp_path):
    job, seen, out = jobs(tmp_path)["tune"], Seen(), tmp_path / "out"
    assert run(job.line(tmp_path / "whole")).code == 0
    with (
        dask_cluster(tmp_path) as (address, scheduler),
        running(job.line(out, "--cluster", address)) as (process, ended),
    ):
        begun(job, out, 5)(process)
        scheduler.kill()
        found = ended()
    seen.refused(found, tmp_path, 2, "--cluster tcp://", "the scheduler was lost", "run the command again")
    assert not seen.wrong
    assert not half_written(out)
    assert not temporary(out)
    assert not (out / ".tune-parts").exists()
    assert 5 <= len(job.finished(out)) < 80
    goes_on = run(job.line(out))
    assert goes_on.code == 0, goes_on.err
    assert job.digest(out) == job.digest(tmp_path / "whole")


@pytest.mark.slow
def test_a_study_whose_workers_are_all_gone_says_so_and_goes_on_with_a_new_one(tmp_path):
    job, out = jobs(tmp_path)["study"], tmp_path / "out"
    with dask_scheduler(tmp_path) as (address, _), running(job.line(out, "--cluster", address)) as (process, ended):
        with dask_workers(address, 1):
            begun(job, out, 2)(process)
        time.sleep(GONE_S + 5.0)
        assert process.poll() is None
        with dask_workers(address, 1):
            found = ended()
    assert found.code == 0, found.err
    assert "no worker is left; waiting for one" in found.err
    assert "goes on with a new worker" in found.err
    assert run(job.line(tmp_path / "whole")).code == 0
    assert job.digest(out) == job.digest(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["study", "tune"])
def test_ctrl_c_on_a_terminal_ends_workers_and_the_command_continues_on_threads(tmp_path, name):
    psutil = pytest.importorskip("psutil")
    job, digest = reference(tmp_path, name)
    out = tmp_path / "out"
    with running(job.line(out, "--cluster", "local:2")) as (process, ended):
        begun(job, out, 4)(process)
        workers = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, signal.SIGINT)
        found = ended()
    assert found.code == 130
    assert "Traceback" not in found.err
    assert found.err.splitlines()[-1].startswith(("trackwright: interrupted; ", "stopped: "))
    assert not psutil.wait_procs(workers, timeout=10)[1]
    assert not (out / ".tune-parts").exists()
    assert run(job.line(out)).code == 0
    assert job.digest(out) == digest
