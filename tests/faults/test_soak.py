"""What counts as flat over many rounds, and a short soak."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.faults.soak import judged

ROOT = Path(__file__).parents[2]
LEAKS = """
import sys, json
from pathlib import Path
from tests.faults.soak import judged, rounds
kept = []
found = rounds(float(sys.argv[1]), Path(sys.argv[2]), lambda: kept.append(b"x" * 4_000_000))
print(json.dumps({name: one.get("flat") for name, one in judged(found).items()}))
"""


def _rounds(slope, n=60, noise=5.0, **more):
    rng = np.random.default_rng(3)
    return [{"resident memory": 600 + slope * k + noise * rng.normal(), **more} for k in range(n)]


def test_memory_that_only_scatters_is_flat():
    assert judged(_rounds(0.0))["resident memory"]["flat"]


def test_memory_that_grows_by_half_a_megabyte_a_round_is_not():
    assert not judged(_rounds(0.5))["resident memory"]["flat"]


def test_what_grows_in_the_first_half_alone_is_flat():
    filled = [{"files in the cache": min(k, 20)} for k in range(60)]
    assert judged(filled)["files in the cache"]["flat"]
    assert not judged([{"open files": 20 + k // 10} for k in range(60)])["open files"]["flat"]


def test_a_short_series_is_not_called_flat():
    assert "flat" not in judged(_rounds(0.0, n=5))["resident memory"]


@pytest.mark.slow
def test_three_minutes_are_flat(tmp_path):
    line = [sys.executable, "-m", "tests.faults", "soak", "--hours", "0.05", "--out", str(tmp_path)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((tmp_path / "soak.json").read_text())["judged"]["resident memory"]["flat"]


@pytest.mark.slow
def test_a_leak_of_four_megabytes_a_round_is_not_flat(tmp_path):
    line = [sys.executable, "-c", LEAKS, "0.04", str(tmp_path)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True)
    assert not json.loads(done.stdout.splitlines()[-1])["resident memory"]
