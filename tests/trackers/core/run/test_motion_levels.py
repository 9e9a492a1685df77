"""Several levels of motion: weights against Bayes' rule over dense Gaussians, moments, smoothing, and what they find."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from scipy.special import logsumexp

import trackwright as tw
from tests.in_process import trackwright
from trackwright.sim import worlds
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.motion_levels import MotionLevels, _smoothed, mixture_of
from trackwright.trackers.core.run.tracker import filter_batch
from trackwright.trackers.from_arrays import fix_recording
from trackwright.trackers.recordings.folder import write_recording
from trackwright.trackers.uwb_imu.multilateration import multilateration_tracker

ROWS = 12
FACTORS, PRIOR = (1.0, 0.3, 0.1), np.array([0.8, 0.1, 0.1])


def _recording(part=slice(None)):
    rng = np.random.default_rng(3)
    fixes = np.cumsum(rng.normal(0, 0.1, (ROWS, 2)), axis=0)
    return fix_recording((np.arange(ROWS) * 0.5)[part], fixes[part], height=1.0)


@pytest.fixture(scope="module")
def recording():
    return _recording()


@pytest.fixture
def members(recording):
    """Estimates of each member by itself, (K, …)."""
    plain = fix_tracker(planar=True)
    level = float(plain.motion.sigma_a.value)
    return [plain.with_values({"motion.sigma_a": level * f}).run(recording) for f in FACTORS]


def test_without_forgetting_weights_are_bayes_rule_and_estimates_the_moments_of_the_mixture(recording, members):
    # A time constant without end, and readings that are independent.
    estimates = MotionLevels(fix_tracker(planar=True), FACTORS, 0.8, 1e-30, 1e30).run(recording)
    likelihoods = np.stack([one.log_likelihood for one in members])
    joint = np.log(PRIOR)[:, None] + np.cumsum(likelihoods, axis=1)
    weights = np.exp(joint - logsumexp(joint, axis=0))
    assert weights[:, -1].min() > 1e-6
    np.testing.assert_allclose(np.cumsum(estimates.log_likelihood), logsumexp(joint, axis=0), rtol=1e-9, atol=1e-12)
    x = np.stack([np.stack(one.mean.position, axis=-1) for one in members])
    mean = np.einsum("kt,ktd->td", weights, x)
    np.testing.assert_allclose(np.stack(estimates.mean.position, axis=-1), mean, rtol=1e-9, atol=1e-12)
    covs = np.stack([one.covariance[:, :2, :2] for one in members])
    apart = x - mean
    spread = np.einsum("kt,ktij->tij", weights, covs + apart[..., :, None] * apart[..., None, :])
    np.testing.assert_allclose(estimates.covariance[:, :2, :2], spread, rtol=1e-8, atol=1e-12)


def test_smoothed_weights_are_those_of_the_hidden_markov_model_by_summing_over_every_sequence():
    rng = np.random.default_rng(1)
    T, K = 5, 3
    evidence, dt = rng.normal(0, 1.5, (K, T)), np.array([0.0, 1.0, 0.5, 2.0, 0.1])
    prior = PRIOR
    stays = np.exp(-dt / 2.0)
    sums, filtered = np.zeros((T, K)), np.zeros((T, K))
    for sequence in itertools.product(range(K), repeat=T):
        chance = prior[sequence[0]] * np.exp(evidence[sequence[0], 0])
        for t in range(T):
            if t:
                same = float(sequence[t] == sequence[t - 1])
                chance *= (stays[t] * same + (1 - stays[t]) * prior[sequence[t]]) * np.exp(evidence[sequence[t], t])
            # The sums over the rest of a sequence up to here, each as often as it goes on.
            filtered[t, sequence[t]] += chance / K ** (T - 1 - t)
        for t in range(T):
            sums[t, sequence[t]] += chance
    shape = (K, T, 1)
    weights = jnp.asarray((filtered / filtered.sum(axis=1, keepdims=True)).T.reshape(shape))
    smoothed = _smoothed(
        weights, jnp.asarray(evidence.reshape(shape)), *map(jnp.asarray, (1 - stays[:, None], PRIOR[:, None]))
    )
    np.testing.assert_allclose(smoothed[:, :, 0].T, sums / sums.sum(axis=1, keepdims=True), rtol=1e-9)


def test_a_member_without_a_track_has_no_share(members, recording):
    together = MotionLevels(fix_tracker(planar=True)).run(recording)
    assert (together.status == Status.OK).all()
    batch = stack([recording])
    outputs = jax.vmap(lambda f: filter_batch(fix_tracker(planar=True), batch))(jnp.arange(2.0))
    lost = outputs.status.at[1].set(Status.LOST)
    broken = outputs._replace(status=lost, mean=jax.tree_util.tree_map(lambda x: x.at[1].set(np.nan), outputs.mean))
    weights = jnp.full((2, ROWS, 1), 0.5)
    mixed = mixture_of(broken, weights)
    for a, b in zip(*(jax.tree_util.tree_leaves((x.mean, x.cov)) for x in (mixed, outputs)), strict=True):
        np.testing.assert_allclose(a, b[0], rtol=1e-12)
    nowhere = mixture_of(outputs._replace(status=jnp.full_like(lost, Status.LOST)), weights)
    assert (nowhere.status == Status.LOST).all()


def test_a_continued_run_has_the_numbers_of_the_whole(recording):
    tracker = MotionLevels(fix_tracker(planar=True))
    whole = tracker.run(recording)
    first, second = _recording(slice(7)), _recording(slice(7, None))
    rest = tracker.run(second, initial=tracker.run(first).final)
    np.testing.assert_allclose(rest.log_likelihood, whole.log_likelihood[7:], rtol=1e-12)
    np.testing.assert_allclose(rest.mean.position[0], whole.mean.position[0][7:], rtol=1e-12)


def test_a_trolley_that_hardly_moves_is_tracked_better_and_a_walk_not_worse():
    hall = worlds.ranges(n=1, seed=4, rows=400)
    walk = hall.folder()
    tracker = tw.build("uwb", walk)
    error = {}
    for name, folder in (("walk", walk), ("still", _still(walk))):
        for kind, one in (("given", tracker), ("levels", tracker.with_motion_levels())):
            error[name, kind] = tw.evaluate(one.run(folder), folder)["rmse_m"]
    assert error["still", "levels"] < 0.95 * error["still", "given"]
    assert error["walk", "levels"] < 1.03 * error["walk", "given"]


def test_the_command_tracks_as_python_does(tmp_path):
    folder = worlds.agv(n=1, seed=2, rows=40).folder()
    path = tmp_path / "hall"
    write_recording(folder, path)
    options = ("--tracker", "fix-kf", "--motion", "auto", "--no-figures", "--no-report", "--out", tmp_path / "run")
    done = trackwright("track", path, *options)
    assert done.code == 0, done
    written = pl.read_parquet(tmp_path / "run" / "tracks.parquet")
    read = tw.read(path)
    expected = tw.build("fix-kf", read).with_motion_levels().run(read).to_polars()
    assert written.select("t_s", "x_m", "log_likelihood").equals(expected.select("t_s", "x_m", "log_likelihood"))
    assert not written["x_m"].equals(tw.build("fix-kf", read).run(read).to_polars()["x_m"])


def _still(folder):
    """The recording of a tag that stays where it began, with the same errors of ranges."""
    truth, ranges = folder.tables["truth"], folder.tables["ranges"]
    at = np.stack([truth[f"{axis}_m"].to_numpy() for axis in "xyz"], axis=1)
    there = np.stack([np.interp(ranges["t_s"], truth["t_s"], x) for x in at.T], axis=1)
    anchors = np.array([folder.rig.anchors[name] for name in ranges["anchor"]])
    change = np.linalg.norm(at[0] - anchors, axis=1) - np.linalg.norm(there - anchors, axis=1)
    tables = dict(folder.tables)
    tables["ranges"] = ranges.with_columns(range_m=ranges["range_m"].to_numpy() + change)
    tables["truth"] = truth.with_columns(**{f"{a}_m": np.full(len(truth), at[0, k]) for k, a in enumerate("xyz")})
    return dataclasses.replace(folder, tables=tables)


def test_a_tracker_without_a_level_of_motion_is_refused():
    with pytest.raises(UnusableInput, match="no process noise of the horizontal motion"):
        MotionLevels(multilateration_tracker())
