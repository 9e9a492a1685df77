"""Identities that every tracker of the catalogue keeps to the bit: padding, masks, company in a batch, compilation.

All runs of a case have one shape, so that they share one compiled program.
"""

import equinox as eqx
import jax
import numpy as np
import pytest

from tests.catalogue import CASES, ROWS
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import replaced, tunables
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.recordings.trajectories import cut

SPOILT = 2
"""The trajectory whose measurements a test spoils."""


class Ran:
    """A case of the catalogue, its recordings, and its estimates."""

    def __init__(self, case):
        self.case, self.tracker, self.recordings = case, case.tracker(), case.recordings()
        self.batch = stack(self.recordings, rows=ROWS)
        self.estimates = self.tracker.run(self.batch)

    def changed(self, change):
        """The batch with each reading changed by a function of it."""
        return self.batch._replace(readings={name: change(r) for name, r in self.batch.readings.items()})


def _params(cases):
    return [pytest.param(case, marks=[] if case.quick else [pytest.mark.slow], id=case.name) for case in cases]


@pytest.fixture(scope="module", params=_params(CASES.values()))
def ran(request):
    return Ran(request.param)


def _leaves(estimates, rows):
    fields = ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status")
    return [np.asarray(x)[..., rows] for x in jax.tree_util.tree_leaves([getattr(estimates, f) for f in fields])]


def _assert_same_bits(mine, other, rows=slice(None)):
    for a, b in zip(_leaves(mine, rows), _leaves(other, rows), strict=True):
        np.testing.assert_array_equal(a, b)


def _assert_same_bits_of_recordings(ran, estimates):
    """The same bits in all rows of every recording, whatever the padding holds."""
    for k, recording in enumerate(ran.recordings):
        _assert_same_bits(estimates[k], ran.estimates[k], slice(len(recording)))


def test_few_trajectories_have_the_numbers_of_many(ran):
    one = ran.tracker.run(ran.batch.columns(0, 1))
    for mine, other in zip(_leaves(one, slice(None)), _leaves(ran.estimates, slice(None)), strict=True):
        np.testing.assert_allclose(mine[..., :1, :], other[..., :1, :], rtol=1e-7, atol=1e-9)


def test_a_case_has_all_that_an_identity_needs(ran):
    """Masked channels, padding, and rows with estimates; else the identities would hold of nothing."""
    seen = np.concatenate(
        [
            r.seen[:, :, k][ran.batch.valid[:, k]].ravel()
            for r in ran.batch.readings.values()
            for k in range(ran.batch.size)
        ]
    )
    assert not seen.all()
    assert not ran.batch.valid.all()
    assert np.mean(ran.estimates.status == Status.OK) > 0.5
    assert not np.any(ran.estimates.status == Status.NON_FINITE)


def test_numbers_in_padding_rows_change_no_bit(ran):
    hidden = ~ran.batch.valid

    def filled(x):
        return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), np.asarray(1e30, x.dtype), x)

    def reversed_in_time(x):
        # Other inputs, though such as there are: numbers of anchors are checked before a run.
        return np.where(np.expand_dims(hidden, tuple(range(1, x.ndim - 1))), x[::-1], x)

    dirty = ran.batch._replace(
        dt=filled(ran.batch.dt),
        readings=jax.tree_util.tree_map(filled, ran.batch.readings),
        inputs=jax.tree_util.tree_map(reversed_in_time, ran.batch.inputs),
    )
    estimates = ran.tracker.run(dirty)
    _assert_same_bits_of_recordings(ran, estimates)
    assert np.all(estimates.status[hidden.T] == Status.PADDING)


def test_a_belief_passes_padding_rows_unchanged(ran):
    if not isinstance(ran.tracker, Tracker):
        pytest.skip("without a belief")
    for k, recording in enumerate(ran.recordings):
        end = len(recording)
        for leaf in jax.tree_util.tree_leaves((ran.estimates[k].mean, ran.estimates[k].cov_upper)):
            np.testing.assert_array_equal(leaf[..., end:], np.repeat(leaf[..., end - 1 : end], ROWS - end, axis=-1))


def test_rows_after_a_row_change_no_bit_of_it(ran):
    """A recording that ends earlier has the same estimates up to its end: it is padded, and filters look back alone."""
    if not ran.case.causal:
        pytest.skip("a smoothed estimate depends on later rows")
    ends = np.random.default_rng(0).integers(5, 35, len(ran.recordings))
    shorter = ran.tracker.run(stack([cut(r, 0, end) for r, end in zip(ran.recordings, ends, strict=True)], rows=ROWS))
    for k, end in enumerate(ends):
        _assert_same_bits(shorter[k], ran.estimates[k], slice(end))


def test_padding_columns_change_no_bit(ran):
    fewer = ran.tracker.run(stack(ran.recordings[:5], rows=ROWS))
    for k in range(5):
        _assert_same_bits(fewer[k], ran.estimates[k])


def test_a_trajectory_is_the_same_in_every_column(ran):
    order = np.random.default_rng(1).permutation(len(ran.recordings))
    shuffled = ran.tracker.run(stack([ran.recordings[k] for k in order], rows=ROWS))
    for column, k in enumerate(order):
        _assert_same_bits(shuffled[column], ran.estimates[k])


@pytest.mark.parametrize("garbage", [1e30, -1e30, None])
def test_garbage_in_one_trajectory_changes_no_bit_of_the_others(ran, garbage):
    rng = np.random.default_rng(2)

    def spoilt(reading):
        values, seen = reading.values.copy(), reading.seen.copy()
        values[..., SPOILT] = rng.normal(size=values.shape[:-1]) * 1e3 if garbage is None else garbage
        seen[..., SPOILT] = True
        return reading._replace(values=values, seen=seen)

    estimates = ran.tracker.run(ran.changed(spoilt))
    for k in range(len(ran.recordings)):
        if k != SPOILT:
            _assert_same_bits(estimates[k], ran.estimates[k])
    different = [
        not np.array_equal(a, b, equal_nan=True)
        for a, b in zip(
            _leaves(estimates[SPOILT], slice(None)), _leaves(ran.estimates[SPOILT], slice(None)), strict=True
        )
    ]
    assert any(different)


@pytest.mark.parametrize("hidden", [1e30, -7.0])
def test_the_value_of_a_masked_channel_changes_no_bit(ran, hidden):
    estimates = ran.tracker.run(ran.changed(lambda r: r._replace(values=np.where(r.seen, r.values, hidden))))
    _assert_same_bits(estimates, ran.estimates)


def test_a_second_run_with_other_numbers_compiles_nothing(ran):
    """Other measurements and other values of all tunables: the program is that of the shapes."""
    nodes = tunables(ran.tracker).items()
    other = replaced(ran.tracker, {name: eqx.tree_at(lambda n: n.raw, node, node.raw + 0.05) for name, node in nodes})
    rng = np.random.default_rng(3)
    batch = ran.changed(lambda r: r._replace(values=r.values + 0.1 * r.seen * rng.normal(size=r.values.shape)))
    compiled = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x + 41.5)(1.0)
        assert compiled, "the listener hears no compilation at all"
        compiled.clear()
        estimates = other.run(batch)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not compiled
    pairs = zip(_leaves(estimates, slice(None)), _leaves(ran.estimates, slice(None)), strict=True)
    assert not all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
