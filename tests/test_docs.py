"""The Markdown code that users copy is run, so that it can't rot."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def _blocks(path):
    return re.findall(r"^```python\n(.*?)^```", (ROOT / path).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def extended():
    """What stands in the namespace after all Python blocks of docs/extending.md have run in order."""
    names = {"__name__": "extending"}
    for block in _blocks("docs/extending.md"):
        exec(compile(block, "docs/extending.md", "exec", dont_inherit=True), names)
    return names


def test_a_motion_and_a_sensor_of_ones_own_take_under_30_lines_together():
    first = _blocks("docs/extending.md")[0]
    code = first[first.index("class Walker") :].splitlines()
    assert sum(1 for line in code if line.strip()) < 30


def test_the_extended_tracker_follows_its_walk(extended):
    estimates, true = extended["estimates"], extended["walks"][0].truth["position"][0]
    error = np.linalg.norm(np.stack(list(estimates.mean.position), axis=-1) - true, axis=-1)
    assert estimates.verdict() == "ok"
    # A single range has 0.3 m of noise; a filter over about 2.7 ranges a row stays well below it.
    assert np.sqrt(np.mean(error[10:] ** 2)) < 0.3


def test_fitting_the_extended_tracker_finds_the_noise_its_ranges_were_drawn_with(extended):
    result = extended["result"]
    found, error = result.values["sensors.ranges.sigma_r"], result.standard_errors["sensors.ranges.sigma_r"]
    assert abs(found - 0.3) < 3 * error
