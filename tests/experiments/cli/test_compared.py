"""Trackers of an archive compared over recordings, beside SciPy's paired t-test."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from trackwright.experiments.cli.archive_tables import SHOWN, Run, compared

NUMBERS = np.random.default_rng(6).uniform(0.1, 0.2, (2, len(SHOWN), 40))


def _run(name, values, first=0):
    run = Run(name, name, bearing=False)
    for k, own in enumerate(values.T):
        run.recordings.append({"recording": f"r{first + k}", **dict(zip(SHOWN, own.tolist(), strict=True))})
    return run


def _numbers(cell):
    return [float(word) for word in cell.replace("(", "").replace(")", "").replace("…", "").split()]


def test_differences_are_those_of_a_paired_t_test_over_common_recordings():
    a, b = NUMBERS
    over, differences = compared([_run("a", a), _run("b", b[:, 10:], 10)])
    a, b = a[:, 10:], b[:, 10:]
    assert [row[0] for row in over.rows] == ["a", "b"]
    assert [float(row[1]) for row in over.rows] == pytest.approx([100 * np.median(x[0]) for x in (a, b)], abs=0.005)
    assert [float(row[4].split()[0]) for row in over.rows] == pytest.approx(
        [100 * np.mean(a[0] < b[0]), 100 * np.mean(b[0] < a[0])], abs=0.5
    )
    for k, row in enumerate(differences.rows):
        expected = stats.ttest_rel(b[k], a[k])
        interval = expected.confidence_interval(0.95)
        found, unit = _numbers(row[4]), 1 if SHOWN[k] == "log_density" else 100  # lengths in cm, shares in %
        assert found == pytest.approx(unit * np.array([np.mean(b[k] - a[k]), interval.low, interval.high]), abs=0.05)
    assert "Paired over 30 recordings" in differences.note


def test_trackers_without_a_common_recording_are_not_compared():
    a, b = NUMBERS
    assert compared([_run("a", a), _run("b", b, 40)]) == []
    assert compared([_run("a", a)]) == []
    few = compared([_run("a", a[:, :3]), _run("b", b[:, :3])])
    assert few[1].note == "No intervals with fewer than 5."
