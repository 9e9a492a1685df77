"""One row at a time, seeds, and the pure function behind a run, for every tracker of the catalogue."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.catalogue import CASES
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.run.tracker import filter_batch

QUICK = ("fix-kf", "particles", "median", "das in the plane of the array")
"""One of each kind: a Kalman filter, random numbers, a window, composed trackers, a tracker without memory."""

CAUSAL = [
    pytest.param(case, marks=[] if name in QUICK else [pytest.mark.slow], id=name)
    for name, case in CASES.items()
    if case.causal
]


class Whole:
    """A case of the catalogue and the estimates of its recordings, each run from the first row to the last."""

    def __init__(self, case):
        self.case, self.tracker, self.recordings = case, case.tracker(), case.recordings()
        self.estimates = self.tracker.run(self.recordings)


@pytest.fixture(scope="module", params=CAUSAL)
def whole(request):
    return Whole(request.param)


def _leaves(estimates, rows=slice(None)):
    fields = ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status")
    return [np.asarray(x)[..., rows] for x in jax.tree_util.tree_leaves([getattr(estimates, f) for f in fields])]


def _same(mine, other):
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(_leaves(mine), _leaves(other), strict=True))


def test_a_seed_gives_the_same_numbers_again_and_another_seed_others_where_any_are_drawn(whole):
    assert _same(whole.tracker.run(whole.recordings), whole.estimates)
    assert _same(whole.tracker.run(whole.recordings, seed=1), whole.estimates) != whole.case.draws


def test_equal_recordings_without_ids_differ_where_random_numbers_are_drawn(whole):
    same = whole.tracker.run([replace(whole.recordings[0], id=None)] * len(whole.recordings))
    assert _same(same[0], same[1]) != whole.case.draws


@pytest.mark.slow
def test_the_pure_function_under_jit_gives_the_run_to_rounding(whole):
    """Bits may differ: XLA compiles the two with different options."""
    output = eqx.filter_jit(filter_batch)(whole.tracker, stack(whole.recordings))
    jitted = (output.mean, output.log_likelihood, output.nis, output.status)
    run = whole.estimates
    expected = (run.mean, run.log_likelihood, run.nis, run.status)
    for mine, other in zip(*map(jax.tree_util.tree_leaves, (jitted, expected)), strict=True):
        np.testing.assert_allclose(np.moveaxis(np.asarray(mine), -1, 0), other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(CASES[name], marks=[] if name == "fix-kf" else [pytest.mark.slow], id=name)
        for name in (
            *QUICK[:3],
            "mhk with memory",
            "multilateration in space",
            "uwb-imu in space",
            "fix-mirror",
            "line-grid without halts",
        )
    ],
)
@pytest.mark.slow
def test_gradients_go_through_the_pure_function_by_jax_and_are_those_of_differences(case):
    """Of the last positions by the values of the first readings, and the same mapped over two batches."""
    tracker, batch = case.tracker(), stack(case.recordings()[:2])
    name = next(iter(batch.readings))
    values = jnp.asarray(batch.readings[name].values)

    def figure(shift):
        reading = batch.readings[name]._replace(values=values + shift)
        output = filter_batch(tracker, batch._replace(readings={**batch.readings, name: reading}))
        return jnp.sum(output.mean.position[0][-1])

    # Particles and cells of a grid have derivatives in forward mode alone.
    forward = case.draws or case.reads == "line-grid"
    at, step = jnp.asarray([0.0, 0.02]), 1e-6
    slopes = jax.jit(jax.vmap((jax.jacfwd if forward else jax.grad)(figure)))(at)
    differences = jax.jit(jax.vmap(lambda x: (figure(x + step) - figure(x - step)) / (2 * step)))(at)
    if case.draws:
        # Particles have their own derivative, in score form, which holds their states fixed.
        assert np.all(np.isfinite(slopes))
    else:
        # A start is held fixed, and its share of the last position decays.
        np.testing.assert_allclose(slopes, differences, rtol=1e-5, atol=1e-9)
