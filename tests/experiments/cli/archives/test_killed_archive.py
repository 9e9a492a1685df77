"""An archive whose command is killed again and again ends as if nothing had happened."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.experiments.cli.archives.small_archive import write_archive

COUNT, KILLS = 300, 8
TABLES = ("tracks.parquet", "events.parquet", "evaluation.json", "results.csv")


@pytest.mark.slow
def test_three_hundred_recordings_killed_and_resumed_have_the_same_bits(tmp_path):
    write_archive(tmp_path / "archive", COUNT)
    words = [
        sys.executable,
        "-m",
        "trackwright.experiments",
        "track",
        str(tmp_path / "archive"),
        "--no-figures",
        "--out",
    ]
    subprocess.run([*words, str(tmp_path / "whole")], check=True, capture_output=True)
    out, rng, kept = tmp_path / "out", np.random.default_rng(5), [0]

    def finished():
        return len(list(out.glob("recordings/*/tracked.json")))

    for more in rng.integers(5, COUNT // KILLS // 2, KILLS):
        running = subprocess.Popen([*words, str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while running.poll() is None and finished() < kept[-1] + more:
            time.sleep(0.01)
        running.kill()
        assert running.wait() == -signal.SIGKILL
        kept.append(finished())
    assert kept == sorted(kept)
    assert kept[-1] < COUNT
    subprocess.run([*words, str(out)], check=True, capture_output=True)
    for name in TABLES:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
