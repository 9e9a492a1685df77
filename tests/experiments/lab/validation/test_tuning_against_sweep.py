"""The comparison of gradient and sweep: its recordings, its models, and its failures."""

import numpy as np
import pytest

from trackwright.experiments.lab.validation.tuning_against_sweep import (
    GOALS,
    SIGMA,
    Found,
    Score,
    failed,
    recordings,
    table,
)
from trackwright.trackers.core.model.tunable import tunables

SWEPT = [Found("sweep", "particles", goal, 0.1, 9090, 400.0) for goal in GOALS]
BEST = [Score(0.2, 0.24), Score(0.21, 0.23)]


def test_nine_recordings_are_three_of_each_situation_and_no_two_alike():
    world = recordings(3)
    (rows,) = world.rows
    assert rows.size == 9
    fixes = np.asarray(rows.readings["fixes"].values)[:300]
    for k in range(9):
        assert all((fixes[..., k] != fixes[..., other]).any() for other in range(k))
    # a halt at each of four joins makes its three recordings longer
    lasting = np.asarray(rows.valid).sum(axis=0)
    assert sorted(lasting)[-3:] == [lasting.max()] * 3
    assert lasting.min() < lasting.max()


def test_both_trackers_have_the_same_model():
    world = recordings(1)
    assert float(tunables(world.particles)[SIGMA].value) == float(tunables(world.grid)[SIGMA].value)
    assert float(world.particles.motion.line.length) == float(world.grid.motion.line.length)


@pytest.mark.parametrize(
    ("found", "score", "words"),
    [
        (Found("fit", "grid", "rmse", 0.1, 90, 100.0), Score(0.2039, 0.3), None),
        (Found("fit", "grid", "rmse", 0.1, 90, 100.0), Score(0.2041, 0.3), "rmse 0.2041, the sweep's best 0.2000"),
        (Found("fit", "grid", "nll", 0.1, 90, 100.0), Score(0.3, 0.2345), None),
        (Found("fit", "grid", "nll", 0.1, 90, 100.0), Score(0.3, 0.2347), "nll 0.2347, the sweep's best 0.2300"),
        (Found("fit", "grid", "nll", 0.1, 454, 100.0), Score(0.3, 0.23), None),
        (Found("fit", "grid", "nll", 0.1, 455, 100.0), Score(0.3, 0.23), "455 filter runs, the sweep 9090"),
        (Found("fit", "grid", "rmse", 0.1, 90, 100.0), Score(float("nan"), 0.3), "rmse nan"),
    ],
)
def test_a_fit_fails_that_is_too_inaccurate_or_too_expensive(found, score, words):
    lines = failed(SWEPT, [found], [*BEST, score])
    assert lines == [] if words is None else words in lines[0]


def test_the_table_shows_the_ratios_of_runs_and_of_seconds():
    line = table([*SWEPT, Found("fit", "grid", "nll", 0.1, 90, 100.0)], [*BEST, Score(0.21, 0.23)]).splitlines()[-1]
    assert line.split() == ["fit", "grid", "nll", "0.1000", "21.00", "0.2300", "90", "101.0", "100.0", "4.0"]
