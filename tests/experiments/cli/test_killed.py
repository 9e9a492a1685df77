"""A fit killed at any moment goes on as if nothing had happened."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

KILLS = 20


def _command(*words) -> list[str]:
    return [sys.executable, "-m", "trackwright.experiments", *map(str, words)]


def _tune(world: Path, out: Path) -> list[str]:
    tune = ("--tune", "motion.sigma_a", "sensors.*.sigma*", "--optimiser", "adam", "--steps", 60, "--starts", 3)
    return _command("tune", world, "--tracker", "fix-kf", *tune, "--out", out, "--resume", "--force")


def _killed(command: list[str], checkpoint: Path, wait_for_step: bool, delay: float) -> bool:
    """Run the command and kill it `delay` s after its start, or after its next step; whether it was still running."""
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while wait_for_step and process.poll() is None:
            if checkpoint.exists() and checkpoint.stat().st_mtime_ns != before:
                break
            time.sleep(0.001)
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGKILL)
            return True
    return False


@pytest.mark.slow
def test_a_fit_killed_at_twenty_moments_and_resumed_ends_the_same_to_the_bit(tmp_path):
    world = tmp_path / "world"
    subprocess.run(_command("simulate", "line", "--n", 6, "--out", world), check=True)
    began = time.monotonic()
    subprocess.run(_tune(world, tmp_path / "whole"), check=True)
    whole = time.monotonic() - began
    out, rng = tmp_path / "killed", np.random.default_rng(4)
    checkpoint, kills = out / "checkpoint.npz", 0
    for turn in range(KILLS):
        # Every other time soon after a step, since most of a run is spent before the first one.
        stepping = bool(turn % 2)
        kills += _killed(_tune(world, out), checkpoint, stepping, rng.uniform(0.0, 0.3 if stepping else whole))
        if checkpoint.exists():
            with np.load(checkpoint, allow_pickle=False) as kept:
                assert all(np.all(kept[name] == kept[name]) for name in ("belongs_to", "array_0"))
    assert kills >= KILLS // 2
    subprocess.run(_tune(world, out), check=True)
    for name in ("tuned.toml", "trace.csv"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
