"""The studies of the assembly line: worlds, measures and what they claim, by few runs."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.line_thesis import table_3_1
from trackwright.experiments.lab.papers.line_thesis._assembly_line import (
    AVERAGES,
    COLUMNS,
    PRINTED,
    RECORDINGS,
    SIGMA,
    distances,
    error,
    least,
    open_ended,
    root_mean_square,
)
from trackwright.experiments.monte_carlo import FITTED, Conclusion, ExpectedResult, TrackedRuns
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.sim.line import THESIS_KNOTS


def _run(estimates, truth=None):
    """Estimates (n, T, 2) of a tag, as a measure sees them."""
    solid = [
        np.concatenate([x, np.zeros((*x.shape[:2], 1))], -1) for x in (estimates, estimates if truth is None else truth)
    ]
    rig = SimpleNamespace(path_knots=THESIS_KNOTS)
    times = np.tile(np.arange(estimates.shape[1], dtype=float), (len(estimates), 1))
    known, folder = np.ones(times.shape, bool), SimpleNamespace(rig=rig)
    return TrackedRuns(times, solid[0], None, solid[1], known, None, None, None, folder)


def test_the_printed_averages_are_those_of_the_printed_columns():
    # The Kalman column's is 27.99, printed as 27.9: cut off, not rounded.
    assert np.abs(np.mean(list(PRINTED.values()), axis=0) - AVERAGES).max() < 0.1


def test_the_path_of_the_particles_goes_on_beyond_its_last_knot_as_the_last_case_of_2_5_does():
    line = open_ended(THESIS_KNOTS)
    for d in (13.0, 16.345, 20.0):
        x, y = line.position(d)
        assert np.allclose([x, y], [2.615 + d - 12.295, 4.065], atol=1e-6)  # single precision


def test_the_error_is_the_mean_distance_or_its_root_mean_square():
    run = _run(np.array([[[0.0, 0.0], [3.0, 4.0]]]), np.zeros((1, 2, 2)))
    assert distances(run).tolist() == [[0.0, 5.0]]
    assert error(run) == pytest.approx([2.5])
    assert root_mean_square(run) == pytest.approx([np.sqrt(12.5)])


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    best = fitted("papers/line_thesis/table_3_1")["sigma_particle"]
    study = dataclasses.replace(table_3_1.STUDY, runs=2, grid={SIGMA: (best,)})
    return run_study(study, tmp_path_factory.mktemp("table"))


@pytest.mark.slow
def test_the_filters_stand_in_the_order_of_the_table(table):
    raw, kalman, particle = (table.average("error_m", [(name, t) for name in RECORDINGS]).value for t in COLUMNS)
    # By a quarter and more in the table; eighteen recordings scatter by a few per cent.
    assert particle < 0.9 * kalman < 0.81 * raw
    assert least(table, "Kalman") == table.study.grid[SIGMA][0]


@pytest.mark.slow
def test_the_table_has_its_27_figures_and_says_which_were_fitted(table):
    claims = list(table_3_1.expected(table))
    cells = [c for c in claims if isinstance(c, ExpectedResult) and ", set " in c.quantity]
    assert [c.printed for c in cells] == [x for row in PRINTED.values() for x in row]
    # The particles' path was left open after both of their averages had been seen.
    assert {c.origin for c in cells} == {FITTED}
    # Averages and improvements follow from the 27.
    assert [c.quantity for c in claims if isinstance(c, ExpectedResult) and c.reached is not None] == [
        c.quantity for c in cells
    ]
    # Levels are fitted to the mean of many draws: two of each of nine scatter by a few per cent.
    average = next(c for c in claims if c.quantity == "Table 3.1, average, raw")
    assert abs(average.ratio - 1) < 0.1
    assert sum(isinstance(c, Conclusion) for c in claims) == 4
