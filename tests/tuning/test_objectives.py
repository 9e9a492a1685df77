"""The objectives: figures made of sums, whatever batches the recordings stand in."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.oracles import kalman
from tests.tuning.worlds import SIGMA_START, figure, line_tracker, walks
from trackwright.sim.agv import VehicleDraw
from trackwright.sim.stations import PhaseDraw, work_station
from trackwright.sim.worlds import ranges as ranges_world
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.evaluation.evaluate import rows_of
from trackwright.trackers.evaluation.rows import covariances
from trackwright.tuning.data import fit_data
from trackwright.tuning.objectives import HEIGHT_WEIGHT, NegativeLogLikelihood, RootMeanSquareError, parse_objective
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

LENGTHS = [9, 16, 5, 12]
PATTERNS = ("motion.*", "sensors.*")


def _first(found):
    """Figure, gradient and sums of the only vector."""
    return found.values[0], found.gradients[0], found.sums[0]


def _problem(batches, objective, tracker=None, chunk=512):
    tracker = line_tracker() if tracker is None else tracker
    parameters = select_parameters(tracker, PATTERNS)
    return Problem(tracker, batches, objective, parameters, chunk), flatten(parameters)


def _figures(recordings, objective, rows=16, chunk=512):
    problem, vector = _problem([stack(recordings, rows)], objective, chunk=chunk)
    return _first(problem.evaluate(vector))


@pytest.fixture(scope="module")
def recordings():
    return walks(LENGTHS, seed=0)


def test_the_likelihood_is_the_textbook_filters_per_number_read(recordings):
    value, _, sums = _figures(recordings, NegativeLogLikelihood())
    total = count = 0.0
    for r in recordings:
        gauge = r.readings["gauge"]
        dts = np.diff(r.times)
        moves = [(np.eye(1), np.array([[0.3**2 * dt]])) for dt in dts]
        # the row that starts a track is not scored
        out = kalman(
            moves,
            np.eye(1),
            np.array([[0.2**2]]),
            gauge.values[1:],
            gauge.seen[1:],
            np.zeros(1),
            np.eye(1) * SIGMA_START**2,
        )
        total += out[2].sum()
        count += gauge.seen[1:].sum()
    assert sums[1] == count
    assert value == pytest.approx(-total / count, rel=1e-12)


@pytest.mark.parametrize("objective", [NegativeLogLikelihood(), RootMeanSquareError(dimensions=1)])
def test_recordings_of_many_lengths_at_once_give_the_figure_of_their_separate_sums(recordings, objective):
    value, gradient, sums = _figures(recordings, objective)
    alone = [_figures([r], objective) for r in recordings]
    added = np.sum([s for _, _, s in alone], axis=0)
    np.testing.assert_allclose(sums, added, rtol=1e-12)
    assert value == pytest.approx(float(objective.value(added)), rel=1e-12)
    # chunks of two, and one batch per length: the same figure in other shapes
    paired = _figures(recordings, objective, chunk=2)
    problem, vector = _problem([stack(recordings[:2], 16), stack(recordings[2:], 16)], objective)
    for other in (paired, _first(problem.evaluate(vector))):
        assert other[0] == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(other[1], gradient, rtol=1e-9, atol=1e-14)


def test_a_recording_without_a_single_reading_says_nothing_and_spoils_no_gradient(recordings):
    r = recordings[0]
    silent = walks([9], seed=1, missing=1.0)[0]
    assert not silent.readings["gauge"].seen.any()
    objective = NegativeLogLikelihood()
    with_silence, without = (_figures(rs, objective) for rs in ([r, silent], [r]))
    assert with_silence[0] == pytest.approx(without[0], rel=1e-12)
    np.testing.assert_allclose(with_silence[1], without[1], rtol=1e-12)


LATENCY = {"sensors.fixes.latency": 0.3}


def _folder(name):
    if name in ("beam", "cascade", "direct"):
        return PhaseDraw(work_station(), n_points=60).drawn(2).folder("phases")
    if name == "uwb":
        folder = ranges_world(n=2, rows=200, seed=1).folder()
        ranges = folder.tables["ranges"].with_columns(t_s=(pl.col("t_s") / 0.2).floor() * 0.2)
        # Rows that share a time: the ranges of 0.2 s.
        return replace(folder, tables=folder.tables | {"ranges": ranges.sort("tag", "t_s", maintain_order=True)})
    folder = VehicleDraw(rows=300).drawn(2).folder("agv")
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
    """RMSE and negative log density by objective and dimensions, in NumPy from the table of estimates and the table of truth."""
    rows = rows_of(tracker.run(folder), folder).filter(pl.col("why").is_null())
    if "azimuth_rad" in rows.columns:
        errors = rows.select("error_azimuth_rad", "error_elevation_rad").to_numpy()
        return {("rmse", 2): np.sqrt(np.mean(np.sum(errors**2, axis=1)))}
    errors, P = rows.select(f"error_{a}_m" for a in "xyz").to_numpy(), covariances(rows)
    plane, space = (_density(errors[:, :d], P[:, :d, :d]) for d in (2, 3))
    return {
        ("rmse", 2): np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))),
        ("rmse", 3): np.sqrt(np.mean(np.sum(errors**2, axis=1))),
        ("state-nll", 3): np.mean(plane + HEIGHT_WEIGHT * (space - plane)),
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
        pytest.param("fix-kf", LATENCY, True, 0.02, marks=pytest.mark.slow),
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
    shown = _shown(tracker.smoothing() if smooth else tracker, folder)
    for (objective, dimensions), wanted in shown.items():
        goal = parse_objective(objective, quantity, dimensions)
        assert figure(model, data.rows.batches, goal) == pytest.approx(wanted, rel=rtol, abs=rtol), objective


def test_a_tag_whose_true_place_is_the_origin_has_an_error():
    (walk,) = walks([8], 1)
    walk.truth["position"] = np.zeros((8, 1)), np.ones(8, bool)
    tracker, batch = line_tracker(), stack([walk])
    places = np.asarray(tracker.run(batch).mean.position[0])
    assert figure(tracker, [batch], RootMeanSquareError("position", 1)) == pytest.approx(
        np.sqrt(np.mean(places**2)), rel=1e-6
    )
