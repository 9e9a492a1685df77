"""Commands that are killed: the same command goes on to the same bits."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

STUDY = """
runs = 20000
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
rate_hz = 1.0
[trackers.fix-kf]
"""


def _chunks(out: Path) -> set[tuple[str, int]]:
    return {(path.name, path.stat().st_ino) for path in out.glob("chunks/[0-9]*.npz")}


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on_without_losing_a_chunk_to_the_same_bits(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY, "utf-8")
    words = ["study", str(tmp_path / "study.toml"), "--out"]
    whole, out = tmp_path / "whole", tmp_path / "killed"
    line = [sys.executable, "-m", "trackwright", *words]
    subprocess.run([*line, str(whole)], check=True, capture_output=True)
    with subprocess.Popen([*line, str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and len(_chunks(out)) < len(_chunks(whole)) // 2:
            time.sleep(0.01)
        process.kill()
    before = _chunks(out)
    assert 0 < len(before) < len(_chunks(whole))
    subprocess.run([*line, str(out)], check=True, capture_output=True)
    assert before <= _chunks(out)
    one, other = (json.loads((x / "results.json").read_text("utf-8"))["sha256"] for x in (whole, out))
    assert one == other
