"""Several levels of noise: weights against Bayes' rule over members run alone, moments, smoothing, what they find."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from scipy.special import logsumexp

import trackwright as tw
from tests.in_process import PLAIN, trackwright
from trackwright.sim import worlds
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.run import noise_levels
from trackwright.trackers.core.run.noise_levels import ERRORS, MOTION, Level, NoiseLevels, _smoothed, mixture_of
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import filter_batch
from trackwright.trackers.from_arrays import fix_recording, range_recording
from trackwright.trackers.recordings.folder import write_recording
from trackwright.trackers.uwb_imu.fusion import range_tracker

ROWS = 12
FACTORS, PRIOR = (1.0, 0.3, 0.1), np.array([0.8, 0.1, 0.1])
LEVELS = tuple(Level(prior, motion=factor) for prior, factor in zip(PRIOR.tolist(), FACTORS, strict=True))
FOREVER = {"lasting": 1e-30, "memory": 1e30}
"""Readings that are independent, and levels that last."""

ANCHORS = np.array([[0.0, 0.0, 2.5], [10.0, 0.0, 1.0], [10.0, 8.0, 2.5], [0.0, 8.0, 1.0], [5.0, -1.0, 2.0]])


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
    estimates = NoiseLevels(fix_tracker(planar=True), LEVELS, **FOREVER).run(recording)
    joint, weights = _bayes(members, PRIOR)
    assert weights[:, -1].min() > 1e-6
    np.testing.assert_allclose(np.cumsum(estimates.log_likelihood), logsumexp(joint, axis=0), rtol=1e-9, atol=1e-12)
    x = np.stack([np.stack(one.mean.position, axis=-1) for one in members])
    mean = np.einsum("kt,ktd->td", weights, x)
    np.testing.assert_allclose(np.stack(estimates.mean.position, axis=-1), mean, rtol=1e-9, atol=1e-12)
    covs = np.stack([one.covariance[:, :2, :2] for one in members])
    np.testing.assert_allclose(estimates.covariance[:, :2, :2], _about(mean, x, covs, weights), rtol=1e-8, atol=1e-12)


def _bayes(members, prior):
    """Logarithms of the joint probabilities of levels and rows so far (K, T), and the weights."""
    joint = np.log(prior)[:, None] + np.cumsum([one.log_likelihood for one in members], axis=1)
    return joint, np.exp(joint - logsumexp(joint, axis=0))


def _about(mean, x, covs, weights):
    """The mean square about `mean` (T, d) of a mixture with means (K, T, d) and covariances (K, T, d, d)."""
    apart = x - mean
    return np.einsum("kt,ktij->tij", weights, covs + apart[..., :, None] * apart[..., None, :])


@pytest.mark.parametrize("smoothed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_levels_of_errors_keep_the_estimates_and_report_their_mean_square_error_by_bayes_rule(smoothed):
    recording = _ranges(np.random.default_rng(5), 0.1, rows=80)[0]
    plain = range_tracker(len(ANCHORS), planar=True)
    nodes = tw.tunables(plain)
    alone = []
    for level in ERRORS:
        factors = {"*.sigma_bias": level.biases, "sensors.ranges.sigma_r": level.readings}
        given = {"*.sigma_bias": "motion.sigma_bias", "sensors.ranges.sigma_r": "sensors.ranges.sigma_r"}
        alone.append(plain.with_values({k: float(nodes[given[k]].value) * f for k, f in factors.items()}))
    filtered = [one.run(recording) for one in alone]
    members = [Smoothed(one).run(recording) for one in alone] if smoothed else filtered
    tracker = Smoothed(plain) if smoothed else plain
    estimates = NoiseLevels(tracker, ERRORS, about_first=True, **FOREVER).run(recording)
    weights = _bayes(filtered, np.array([level.prior for level in ERRORS]))[1]
    if smoothed:  # The level does not change, so that every row has the weights of the last.
        weights = np.repeat(weights[:, -1:], len(recording), axis=1)
    assert weights[:, -1].max() < 1 - 1e-6
    usable = np.all([one.status == Status.OK for one in members], axis=0)
    assert usable.sum() > 60
    x = np.stack([np.stack(one.mean.position, axis=-1) for one in members])[:, usable]
    covs = np.stack([one.covariance[:, :2, :2] for one in members])[:, usable]
    np.testing.assert_allclose(np.stack(estimates.mean.position, axis=-1)[usable], x[0], rtol=1e-9)
    expected = _about(x[0], x, covs, weights[:, usable])
    np.testing.assert_allclose(estimates.covariance[usable, :2, :2], expected, rtol=1e-6, atol=1e-10)


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


@pytest.fixture(scope="module")
def outputs(recording):
    """What two equal members find."""
    batch = stack([recording])
    return jax.jit(jax.vmap(lambda f: filter_batch(fix_tracker(planar=True), batch)))(jnp.arange(2.0))


def test_a_member_without_a_track_has_no_share(outputs):
    assert (outputs.status == Status.OK).all()
    lost = outputs.status.at[1].set(Status.LOST)
    broken = outputs._replace(status=lost, mean=jax.tree_util.tree_map(lambda x: x.at[1].set(np.nan), outputs.mean))
    weights = jnp.full((2, ROWS, 1), 0.5)
    mixed = mixture_of(broken, weights)
    for a, b in zip(*(jax.tree_util.tree_leaves((x.mean, x.cov)) for x in (mixed, outputs)), strict=True):
        np.testing.assert_allclose(a, b[0], rtol=1e-12)
    nowhere = mixture_of(outputs._replace(status=jnp.full_like(lost, Status.LOST)), weights)
    assert (nowhere.status == Status.LOST).all()
    without_first = mixture_of(outputs._replace(status=lost[::-1]), weights, about_first=True)
    assert (without_first.status == Status.LOST).all()
    for a, b in zip(
        jax.tree_util.tree_leaves(without_first.mean), jax.tree_util.tree_leaves(outputs.mean), strict=True
    ):
        np.testing.assert_allclose(a, b[0], rtol=1e-12)


def test_a_continued_run_has_the_numbers_of_the_whole(recording):
    faster = (Level(0.5), Level(0.5, readings=0.5))
    tracker = NoiseLevels(NoiseLevels(fix_tracker(planar=True), LEVELS), faster, about_first=True)
    # Side by side they are one program.
    whole, first = tracker.run([recording, _recording(slice(6))])
    rest = tracker.run(_recording(slice(6, None)), initial=first.final)
    np.testing.assert_allclose(rest.log_likelihood, whole.log_likelihood[6:], rtol=1e-12)
    np.testing.assert_allclose(rest.mean.position[0], whole.mean.position[0][6:], rtol=1e-12)
    np.testing.assert_allclose(rest.covariance, whole.covariance[6:], rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("sigma_bias", [0.025, 0.085, 0.17, 0.25])
def test_covariances_follow_the_size_of_the_errors_of_a_site(sigma_bias):
    rng = np.random.default_rng(2)
    worlds_of_site = [_ranges(rng, sigma_bias, rows=800) for _ in range(8)]
    recordings, truth = [one for one, _ in worlds_of_site], np.stack([x for _, x in worlds_of_site])
    plain = range_tracker(len(ANCHORS), planar=True)
    given, levels = (
        _nees(tracker.run(recordings), truth) for tracker in (plain, NoiseLevels(plain, ERRORS, about_first=True))
    )
    assert abs(np.log(levels)) < 0.8 * abs(np.log(given))


def _ranges(rng, sigma_bias, rows):
    """A walk among anchors whose biases (standard deviation `sigma_bias` m) drift, white noise of 2 cm, and the truth.

    A simulation of its own in NumPy: biases decay within 65 s and 5 m, ranges to the anchors in turn at 20 Hz.
    """
    dt, turn = 0.05, np.arange(rows) % len(ANCHORS)
    t, rates, phases = np.arange(rows) * dt, rng.uniform(0.15, 0.35, 2), rng.uniform(0, 2 * np.pi, 2)
    x = np.stack([5 + 3.2 * np.sin(rates[0] * t + phases[0]), 4 + 2.4 * np.sin(rates[1] * t + phases[1])], axis=1)
    speed = np.append(0.0, np.linalg.norm(np.diff(x, axis=0), axis=1)) / dt
    bias, biases = rng.normal(0, sigma_bias, len(ANCHORS)), []
    for lapse in dt * (1 / 65 + speed / 5):
        step = np.sqrt(-np.expm1(-2 * lapse)) * rng.normal(0, sigma_bias, len(ANCHORS))
        bias = bias * np.exp(-lapse) + step
        biases.append(bias)
    position = np.column_stack([x, np.ones(rows)])
    shared = 0.07 + rng.normal(0, 0.1)
    ranges = np.linalg.norm(position - ANCHORS[turn], axis=1) + np.array(biases)[np.arange(rows), turn] + shared
    return range_recording(t, ranges + rng.normal(0, 0.02, rows), ANCHORS, anchor=turn, height=1.0), x


def _nees(estimates, truth):
    """NEES/dof over the floor after the first fifth of the rows."""
    later = slice(truth.shape[1] // 5, None)
    error = (np.stack(estimates.mean.position, axis=-1) - truth)[:, later]
    cov = estimates.covariance[:, later, :2, :2]
    return np.mean(np.einsum("bti,btij,btj->bt", error, np.linalg.inv(cov), error)) / 2


@pytest.fixture(scope="module")
def walk():
    return worlds.ranges(n=1, seed=4, rows=400).folder()


def test_a_trolley_that_hardly_moves_is_tracked_better_and_a_walk_not_worse(walk):
    tracker = tw.build("uwb", walk)
    error = {}
    for name, folder in (("walk", walk), ("still", _still(walk))):
        for kind, one in (("given", tracker), ("levels", tracker.with_motion_levels())):
            error[name, kind] = tw.evaluate(one.run(folder), folder)["rmse_m"]
    assert error["still", "levels"] < 0.95 * error["still", "given"]
    assert error["walk", "levels"] < 1.03 * error["walk", "given"]


def _commanded(walk, folder, *options):
    """What `track` with options writes of a walk and says, and the walk as it is read."""
    write_recording(walk, folder / "hall")
    done = trackwright("track", folder / "hall", "--tracker", "uwb", *options, *PLAIN, "--out", folder / "run")
    assert done.code == 0, done
    return pl.read_parquet(folder / "run" / "tracks.parquet"), done.err, tw.read(folder / "hall")


def test_without_a_calibration_covariances_are_those_of_levels_of_errors_for_the_same_estimates(walk, tmp_path):
    written, said, read = _commanded(walk, tmp_path / "levels")
    assert "--errors" in said
    expected = tw.build("uwb", read).with_error_levels().run(read).to_polars()
    assert written.select("t_s", "x_m", "std_x_m").equals(expected.select("t_s", "x_m", "std_x_m"))
    given, said, _ = _commanded(walk, tmp_path / "given", "--errors", "given")
    assert "--errors" not in said
    np.testing.assert_allclose(written["x_m"], given["x_m"], rtol=1e-5)
    assert not written["std_x_m"].equals(given["std_x_m"])
    options = ("--tracker", "multilateration", "--errors", "auto", "--out", tmp_path / "no")
    refused = trackwright("track", tmp_path / "given" / "hall", *options)
    assert refused.code == 2
    assert "no biases that drift" in refused.err


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


def test_an_estimated_height_has_levels_of_its_own():
    tracker = fix_tracker()
    levels = noise_levels.levels_of_motion(tracker, False)
    assert len(levels) == 12
    assert sum(level.prior for level in levels) == pytest.approx(1.0)
    assert levels[0].prior == pytest.approx(0.81)
    assert noise_levels.levels_of_motion(tracker, True) == MOTION
    # A vehicle that turns briskly on a flat floor.
    random, times = np.random.default_rng(4), np.arange(0.0, 60.0, 0.2)
    path = np.stack([4.0 * np.cos(0.4 * times), 4.0 * np.sin(0.4 * times), np.ones(len(times))], axis=1)
    recording = fix_recording(times, path + 0.1 * random.standard_normal(path.shape), truth=path)
    horizontal, both = (
        tw.evaluate(NoiseLevels(tracker, of_motion).run(recording), recording) for of_motion in (MOTION, levels)
    )
    assert both["rmse_m"] < 1.02 * horizontal["rmse_m"]
    height = [np.sqrt(e["rmse_3d_m"] ** 2 - e["rmse_m"] ** 2) for e in (horizontal, both)]
    assert height[1] < 0.8 * height[0]
