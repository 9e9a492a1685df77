"""A `track` killed at any moment leaves whole files, and the next one writes the same bits."""

from __future__ import annotations

import signal
import subprocess
import sys

import numpy as np
import polars as pl
import pytest

from tests.faulty import write_good

KILLS = 12


@pytest.mark.slow
def test_tracks_killed_at_random_moments_are_whole_or_absent(tmp_path):
    write_good(tmp_path / "good")
    words = [
        sys.executable,
        "-m",
        "experiments",
        "track",
        str(tmp_path / "good"),
        "--tracker",
        "fix-kf",
        "--no-figures",
    ]
    subprocess.run([*words, "--out", str(tmp_path / "whole")], check=True, capture_output=True)
    out, rng, killed = tmp_path / "out", np.random.default_rng(8), 0
    for _ in range(KILLS):
        running = subprocess.Popen([*words, "--out", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            running.wait(rng.uniform(1.0, 6.0))
        except subprocess.TimeoutExpired:
            running.send_signal(signal.SIGKILL)
            killed += running.wait() == -signal.SIGKILL
        if (out / "tracks.parquet").exists():
            assert pl.read_parquet(out / "tracks.parquet").equals(
                pl.read_parquet(tmp_path / "whole" / "tracks.parquet")
            )
    assert killed
    subprocess.run([*words, "--out", str(out)], check=True, capture_output=True)
    for name in ("tracks.parquet", "events.parquet"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
