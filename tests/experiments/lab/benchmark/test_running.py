"""What is written of an estimator that has no estimate."""

from __future__ import annotations

import pytest

from trackwright.experiments.lab.benchmark.adapters import ours
from trackwright.experiments.lab.benchmark.problems import problems
from trackwright.experiments.lab.benchmark.running import FAILED, write
from trackwright.experiments.lab.benchmark.scoring import cell
from trackwright.experiments.lab.benchmark.worlds import simulated
from trackwright.trackers.core.errors import UnusableInput

NAME = "world-ranges-2d"


@pytest.fixture(scope="module")
def world():
    return simulated(NAME)


def test_an_estimator_of_other_readings_has_no_file(world, tmp_path):
    for name in ("maker", "zero-velocity"):
        assert write(tmp_path, name, world, problems(world)) is None
    assert not list(tmp_path.glob("*/*"))


def test_a_refusal_of_our_tracker_is_a_failure(world, tmp_path, monkeypatch):
    def refused(folder):
        raise UnusableInput("the rig: no anchors")

    monkeypatch.setattr(ours, "filtered", refused)
    reason = write(tmp_path, "trackwright", world, [])
    assert reason == "UnusableInput: the rig: no anchors"
    assert cell(tmp_path / "trackwright" / f"{NAME}{FAILED}", world).failed == reason
