import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.experiments.monte_carlo.small_study import TOML, study_command

pytestmark = pytest.mark.slow


def _sha(folder):
    return json.loads((folder / "results.json").read_text())["sha256"]


@pytest.fixture
def study(tmp_path):
    file = tmp_path / "small.toml"
    file.write_text(TOML.replace("runs = 12", "runs = 1000") + "[grid]\n'world.speed' = [0.2, 0.3, 0.4]\n")
    return file


def test_killed_five_times_at_random_moments_it_ends_with_the_same_numbers(study, tmp_path):
    began = time.perf_counter()
    assert study_command(study, "--out", tmp_path / "whole").returncode == 0
    seconds, rng, chunks = time.perf_counter() - began, np.random.default_rng(5), []
    for _ in range(5):
        words = [
            sys.executable,
            "-m",
            "trackwright.experiments",
            "study",
            str(study),
            "--out",
            str(tmp_path / "killed"),
        ]
        running = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.2, 0.6) * seconds)
        running.send_signal(signal.SIGKILL)
        running.wait()
        chunks.append(len([*(tmp_path / "killed").glob("chunks/*.npz")]))
    assert chunks == sorted(chunks)
    assert study_command(study, "--out", tmp_path / "killed").returncode == 0
    assert _sha(tmp_path / "killed") == _sha(tmp_path / "whole")


def test_a_full_disk_is_one_line_and_costs_nothing_that_was_written(study, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)], capture_output=True)
    if mounted.returncode:
        pytest.skip("no right to mount a small file system here")
    try:
        result = study_command(study, "--out", disk / "out")
        assert result.returncode == 2, result.stderr
        assert "No space left" in result.stderr.splitlines()[-1]
        assert not [name for _, _, files in os.walk(disk) for name in files if name.startswith(".")]
        for path in (disk / "out" / "chunks").glob("*.npz"):
            np.load(path).close()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_killed_worker_costs_a_chunk_and_no_bit(study, tmp_path):
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")
    assert study_command(study, "--out", tmp_path / "threads").returncode == 0
    words = [sys.executable, "-m", "trackwright.experiments", "study", str(study), "--out", str(tmp_path / "workers")]
    running = subprocess.Popen([*words, "--cluster", "local:2"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    _wait_for_chunks(running, tmp_path / "workers", 4)
    workers = [p for p in psutil.Process(running.pid).children(recursive=True) if "spawn_main" in " ".join(p.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    errors = running.communicate(timeout=300)[1].decode()
    assert running.returncode == 0, errors
    assert "Traceback" not in errors
    assert _sha(tmp_path / "workers") == _sha(tmp_path / "threads")


def test_ctrl_c_on_a_terminal_ends_workers_and_leaves_a_study_that_continues(study, tmp_path):
    pytest.importorskip("distributed")
    psutil = pytest.importorskip("psutil")
    words = [sys.executable, "-m", "trackwright.experiments", "study", str(study), "--out", str(tmp_path / "out")]
    running = subprocess.Popen(
        [*words, "--cluster", "local:2"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )
    _wait_for_chunks(running, tmp_path / "out", 4)
    children = psutil.Process(running.pid).children(recursive=True)
    os.killpg(running.pid, signal.SIGINT)
    errors = running.communicate(timeout=60)[1].decode()
    assert running.returncode == 130
    assert errors.splitlines()[1:] == ["trackwright: interrupted; files already written are complete"]
    assert not psutil.wait_procs(children, timeout=10)[1]
    assert study_command(study, "--out", tmp_path / "out").returncode == 0
    assert study_command(study, "--out", tmp_path / "whole").returncode == 0
    assert _sha(tmp_path / "out") == _sha(tmp_path / "whole")


def _wait_for_chunks(running, folder, count):
    while len([*folder.glob("chunks/*.npz")]) < count:
        assert running.poll() is None
        time.sleep(0.05)
