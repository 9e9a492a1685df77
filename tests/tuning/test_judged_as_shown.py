"""Objectives with truth judge the estimates that `track` shows and `evaluate` compares with the truth, all of them."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy import stats

from trackwright.sim.agv import simulate_agv
from trackwright.sim.stations import simulate_phases, work_station
from trackwright.sim.worlds import ranges as ranges_world
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.evaluation.evaluate import associate
from trackwright.trackers.evaluation.scoring import covariances, score
from trackwright.tuning.data import fit_data
from trackwright.tuning.named_objectives import HEIGHT_WEIGHT, all_metrics

LATENCY = {"sensors.fixes.latency": 0.3}


def _folder(name):
    if name in ("beam", "cascade", "direct"):
        return simulate_phases(work_station(), n=2, n_points=60).folder("phases")
    if name == "uwb":
        folder = ranges_world(n=2, rows=200, seed=1).folder()
        ranges = folder.tables["ranges"].with_columns(t_s=(pl.col("t_s") / 0.2).floor() * 0.2)
        # Rows that share a time: the ranges of 0.2 s.
        return replace(folder, tables=folder.tables | {"ranges": ranges.sort("tag", "t_s", maintain_order=True)})
    folder = simulate_agv(2, rows=300).folder("agv")
    if name != "mhk-stamped":
        return folder
    fixes = folder.tables["fixes"]
    # Every fourth fix or so is empty, and once a dozen in a row.
    row = np.arange(len(fixes)) % 300
    empty = pl.Series((np.random.default_rng(0).random(len(fixes)) < 0.25) | ((row > 150) & (row < 163)))
    holes = [pl.when(empty).then(None).otherwise(pl.col(f"{a}_m")).alias(f"{a}_m") for a in "xyz"]
    return replace(folder, tables=folder.tables | {"fixes": fixes.with_columns(*holes)})


def _density(errors, P):
    """The negative log density of errors under normal distributions, nats."""
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P), errors)
    return 0.5 * (nees + np.linalg.slogdet(2 * np.pi * P)[1])


def _shown(tracker, folder):
    """RMSE, negative log density and NEES shape, in NumPy from the table of estimates and the table of truth."""
    association = associate(tracker.run(folder), folder)
    scored = score(association, {folder.name: folder.rig.stations})
    if scored.nees_3d is None:
        return {"rmse": np.sqrt(np.mean(np.sum(scored.errors**2, axis=1)))}
    errors, P = scored.errors, covariances(association.rows[scored.index])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(P), errors)
    plane, space = (_density(errors[:, :d], P[:, :d, :d]) for d in (2, 3))
    u = stats.chi2.cdf(nees, 3)
    means = [np.mean(np.sqrt(2 * k + 1) * np.polynomial.legendre.Legendre.basis(k)(2 * u - 1)) for k in range(1, 5)]
    return {
        "rmse": np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))),
        "rmse-3d": np.sqrt(np.mean(np.sum(errors**2, axis=1))),
        "state-nll": np.mean(plane + HEIGHT_WEIGHT * (space - plane)),
        "nees-shape": np.sum(np.square(means)),
    }


@pytest.mark.parametrize(
    ("name", "values", "smooth", "rtol"),
    [
        pytest.param("beam", {}, False, 1e-9, marks=pytest.mark.slow),
        pytest.param("cascade", {}, False, 1e-9, marks=pytest.mark.slow),
        ("uwb", {}, False, 1e-9),
        pytest.param("mhk", {}, False, 1e-9, marks=pytest.mark.slow),
        pytest.param("mhk-stamped", {}, False, 1e-9, marks=pytest.mark.slow),
        # Six of 600 estimates are valid before the truth begins: the objective continues it there, `evaluate` does not.
        pytest.param("fix-kf", LATENCY, False, 0.02, marks=pytest.mark.slow),
        ("fix-kf", LATENCY, True, 0.02),
    ],
    ids=[
        "beam",
        "cascade",
        "ranges at one time",
        "mhk",
        "mhk-stamped with empty rows",
        "fixes with latency",
        "smoothed fixes with latency",
    ],
)
def test_the_objective_is_the_figure_of_the_estimates_shown(name, values, smooth, rtol):
    folder = _folder(name)
    tracker = build(name, [folder]).with_values(values)
    data = fit_data(tracker.only_batch([folder]), "rmse", dimensions=3)
    model = Smoothed(data.tracker) if smooth else data.tracker
    quantity = "direction" if name == "beam" else "position"
    found = all_metrics(model, data.rows(), quantity, 2 if name == "beam" else 3)
    shown = _shown(tracker.smoothing() if smooth else tracker, folder)
    for objective, figure in shown.items():
        assert found[objective] == pytest.approx(figure, rel=rtol, abs=rtol), objective
