"""A tag that may halt anywhere on its path: against its own chances, and with ranges that are too long for long."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from scipy.stats import norm

import trackwright as tw
from tests.known_start import NEVER_LOST, KnownStart, recording
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.tracker import Tracker, filter_batch
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import HaltingMotion, HaltingState, PathOutputMap
from trackwright.trackers.line.tracker import FloorFixes
from trackwright.trackers.parts.fixes import FIXES

LINE, SIGMA_FIX, TRAVEL, KEYS = Polyline([[0.0, 0.0], [5.0, 0.0]]), 0.3, 2.0, 64
MAP = PathOutputMap(LINE, Scale(1e-3, "m"))
FILTERS = {"particles": ParticleFilter(2000, output_map=MAP), "grid": GridFilter(MAP, 501, 101, 2.0)}
PLACES = np.array([1.0, 2.2, 2.4])
"""x of the fixes, m: the tag comes from 1 m with 1 m/s, and seems to have halted at 2 m."""


def _batch(filter, count):
    motion = HaltingMotion(LINE, 1e-3, rest=1e6, travel=TRAVEL)
    sensor = FloorFixes(SIGMA_FIX, None)
    tracker = Tracker(motion, {FIXES: sensor}, KnownStart(lambda x: HaltingState(*x)), filter, NEVER_LOST)
    fixes = {FIXES: (np.stack([PLACES, 0 * PLACES], axis=1), np.ones((3, 2), bool))}
    at = [1.0, 1.0, 0.0], np.diag([1e-6, 1e-6, 0.0])
    return tracker, stack([recording(np.arange(3.0), fixes, *at, name=f"key {k}") for k in range(count)])


def _log_likelihood(travel):
    """Of the second and third fix: the tag is at 2 m, then at 3 m unless it has halted, and stays there."""
    halted = 1.0 - np.exp(-1.0 / travel)
    across = norm.pdf(0.0, scale=SIGMA_FIX) ** 2
    third = halted * norm.pdf(0.4, scale=SIGMA_FIX) + (1.0 - halted) * norm.pdf(0.6, scale=SIGMA_FIX)
    return np.log(across * norm.pdf(0.2, scale=SIGMA_FIX) * third)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["grid", "particles"])
def test_a_tag_has_halted_with_the_chance_of_its_time_of_travel(kind):
    tracker, batch = _batch(FILTERS[kind], KEYS if kind == "particles" else 1)
    likelihoods = np.exp(np.asarray(tracker.run(batch).log_likelihood, float)[:, 1:].sum(axis=1))
    error = 3 * likelihoods.std() / np.sqrt(len(likelihoods)) / likelihoods.mean() + 0.002
    assert np.log(likelihoods.mean()) == pytest.approx(_log_likelihood(TRAVEL), abs=error)


def test_the_gradient_in_the_time_of_travel_is_that_of_the_chances():
    tracker, batch = _batch(FILTERS["grid"], 1)
    model, rows = as_dtype(tracker, batch.dt.dtype), jax.tree_util.tree_map(jnp.asarray, batch)

    def log_likelihood(raw):
        return filter_batch(eqx.tree_at(lambda t: t.motion.travel.raw, model, raw), rows).log_likelihood.sum()

    slope = jax.jit(jax.jacfwd(log_likelihood))(jnp.asarray(np.log(TRAVEL), batch.dt.dtype))
    ends = [_log_likelihood(TRAVEL * np.exp(step)) for step in (1e-4, -1e-4)]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / 2e-4, abs=2e-3)


@pytest.mark.slow
def test_ranges_that_stay_too_long_leave_the_covariances_within_the_limit_of_regret():
    anchors, times = np.array([[3.0, 0.0, 1.0], [-2.0, -1.0, 1.0]]), np.arange(0.0, 60.0, 0.2)
    x = np.clip(0.5 + 0.1 * (times - 30.0), 0.5, 1.5)
    places = np.stack([x, 0 * x, 0 * x], axis=1)
    too_long = np.array([0.0, 0.1]) + 0.03 * np.random.default_rng(0).standard_normal((len(times), 2))
    ranges = np.linalg.norm(places[:, None] - anchors, axis=2) + too_long
    heard = [{"t_s": times, "tag": "0", "anchor": f"a{k}", "range_m": ranges[:, k]} for k in range(2)]
    truth = pl.DataFrame({"t_s": times, "tag": "0", "x_m": x, "y_m": 0.0, "z_m": 0.0})
    rig = tw.Rig(
        "a",
        {f"a{k}": p for k, p in enumerate(anchors)},
        tags={"0": tw.Tag(0.0)},
        path_knots=np.array([[0.0, 0.0], [2.0, 0.0]]),
    )
    tables = {"ranges": pl.concat(map(pl.DataFrame, heard)).sort("t_s", maintain_order=True), "truth": truth}
    folder = tw.RecordingFolder("a", None, rig, tables)
    assert tw.evaluate(tw.build("line-grid", folder).run([folder]), [folder]).overall["regret"] < 0.3
