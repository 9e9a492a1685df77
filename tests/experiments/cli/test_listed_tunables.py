"""`trackwright trackers NAME`: every number of every tracker that can be set, with its meaning from the docstrings."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.in_process import trackwright
from trackwright.experiments.cli.examples import example_for
from trackwright.trackers.catalogue import TRACKERS, build
from trackwright.trackers.core.model.tunable import meanings

NOT_SIMULATED = ("bearings", "trilateration", "trilateration-compensated", "floor-pf")


@pytest.mark.parametrize("name", sorted({*TRACKERS} - {*NOT_SIMULATED}))
def test_a_docstring_says_what_each_tunable_is(name):
    tracker = build(name, example_for(TRACKERS[name]))
    found = meanings(tracker.tracker)
    assert list(found) == list(tracker.tunables)
    for tunable, sentence in found.items():
        assert tunable.rpartition(".")[2] in sentence.replace("₀", "_0"), tunable


def test_tunables_are_listed_with_values_units_and_bounds():
    done = trackwright("trackers", "fix-kf", "--json")
    assert done.code == 0
    listed = {one.pop("name"): one for one in json.loads(done.out)["tunables"]}
    assert listed["motion.sigma_a"] == {
        "value": 1.0,
        "unit": "m/s^2/sqrt(Hz)",
        "bounds": "> 0",
        "fitted_by_default": True,
        "meaning": listed["motion.sigma_a"]["meaning"],
    }
    assert not any(one["fitted_by_default"] for name, one in listed.items() if name.startswith("start."))
    text = trackwright("trackers", "fix-kf")
    assert "give a recording FOLDER" in text.err
    assert all(name in text.out for name in listed)


def test_values_are_those_of_the_recording(simulated):
    done = trackwright("trackers", "beam", simulated, "--json")
    assert done.err == ""
    found = {one["name"]: one["value"] for one in json.loads(done.out)["tunables"]}
    assert np.shape(found["sensors.phases.offsets"]) == (8,)
