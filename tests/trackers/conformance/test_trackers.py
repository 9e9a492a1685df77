"""A sound tracker of one's own passes all checks, and one with a fault fails the check of that fault with its fix."""

from __future__ import annotations

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

import trackwright as tw
from tests.trackers.conformance.own_trackers import (
    Altered,
    AtTheFirst,
    CountedTwice,
    Unsettled,
    averaged,
    kalman,
    recordings,
)
from trackwright.trackers.conformance.worlds import compare_errors, drawn_world


def _and(add):
    """A change of the output: `add(output, batch)` more in the NIS of each row and trajectory."""
    return lambda output, batch: output._replace(nis=output.nis + add(output, batch))


def _of_padding(output, batch):
    return jnp.max(jnp.where(batch.valid, 0.0, batch.dt), axis=0)[None]


def _of_later_rows(output, batch):
    return jnp.flip(jnp.cumsum(jnp.flip(jnp.where(batch.valid, output.nis, 0.0), 0), axis=0), 0)


def _of_garbage(output, batch):
    reading = batch.readings["places"]
    largest = jnp.max(jnp.where(reading.seen & batch.valid[:, None], jnp.abs(reading.values), 0.0))
    return jnp.where(largest > 20.0, 1.0, 0.0)


def _of_the_number(output, batch):
    return jnp.mean(jnp.asarray(batch.valid)[0].astype(output.nis.dtype))


class Unsure(tw.AbstractStart):
    """Starts nowhere."""

    def can_start(self, row):
        return row.dt < 0

    candidate, belief = AtTheFirst.candidate, AtTheFirst.belief


FAULTS = {
    "padding": (lambda: averaged(_and(_of_padding)), {"padding"}, "in rows of padding.*changes nis"),
    "later rows": (lambda: averaged(_and(_of_later_rows)), {"later rows", "cut and resume"}, "leaving out later rows"),
    "number and order": (
        lambda: averaged(_and(_of_the_number)), {"number and order"}, r"a batch of the recordings \[0, 1, 2, 3, 4\] changes nis"
    ),
    "number and order: order": (
        lambda: averaged(_and(lambda output, batch: jnp.arange(batch.size, dtype=output.nis.dtype)[None])),
        {"number and order"},
        r"a batch of the recordings \[.*\] changes nis",
    ),
    "other tags": (lambda: averaged(_and(_of_garbage)), {"other tags"}, "a reading of 1e\\+30 in recording 2 changes nis"),
    "hidden values": (
        lambda: kalman(change=lambda r, z: r._replace(
            log_scale=r.log_scale + 1e-3 * jnp.where(z.seen[0], 0.0, jnp.asarray(z.values[0]))
        )),
        {"hidden values"},
        "the value 1e\\+30 of a channel that is not seen changes log_likelihood",
    ),
    "cut and resume": (lambda: averaged(forgets=True), {"cut and resume"}, "continues another from row .*`scan` returns"),
    "one program": (lambda: averaged(label=Unsettled()), {"one program"}, "traces [1-9].* programs anew, expected none"),
    "single and batch": (
        lambda: averaged(lambda output, batch: output._replace(nis=output.nis * (1.0 + 1e-3 * batch.size))),
        {"single and batch"},
        "alone and in a batch differ",
    ),
    "accumulate": (lambda: CountedTwice(averaged()), {"accumulate"}, "by `accumulate`, .* by `scan`"),
    "gradient": (lambda: averaged(held=True), {"gradient"}, "by sigma is 0, by difference quotients"),
    "consistency": (lambda: kalman(Altered(of_cov=0.25)), {"consistency"}, "NEES .* are too small"),
    "run: finite": (
        lambda: kalman(change=lambda r, z: r._replace(log_scale=r.log_scale / (z.values[0] - z.values[0]))),
        {"run"},
        "row .* of recording 0 is not finite; usual fix: check_motion",
    ),
    "run": (lambda: kalman(start=Unsure()), {"run"}, "a track runs in 0% of the rows"),
}  # fmt: skip
"""By the check that finds it: a tracker with a fault, all checks that fail with it, and what the sentence says."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n == "consistency" else ()) for n in FAULTS]
)
def test_a_fault_is_found_by_its_check(name):
    tracker, _, message = FAULTS[name]
    check = next(c for c in tw.tracker_checks(tracker(), recordings()) if str(c) == name.partition(":")[0])
    assert check.result.outcome == "fail", check.result
    assert re.search(message, check.result.sentence), check.result
    with pytest.raises(tw.BrokenContract):
        check()


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_fails_no_other_check(name):
    tracker, failing, _ = FAULTS[name]
    report = tw.check_tracker(tracker(), recordings())
    assert {one.name for one in report.failures} == failing, report


@jax.enable_x64(True)
def test_errors_of_another_size_are_named():
    tracker, of_run = kalman(), recordings()
    world = drawn_world(tracker, of_run[0], tracker.run(of_run)[0], 0, n=8)
    for factor, message in ((0.1, "covariances are too small"), (10.0, "covariances are too large")):
        with pytest.raises(AssertionError, match=message):
            compare_errors(world, replace(world.estimates, cov_upper=factor * world.estimates.cov_upper))


@pytest.mark.slow
def test_a_linear_tracker_passes_all_checks():
    report = tw.check_tracker(kalman())
    assert {one.outcome for one in report} == {"pass"}, report


def test_a_tracker_that_is_no_filter_passes_all_checks_that_apply():
    report = tw.check_tracker(averaged(), recordings(3))
    assert not report.failures, report
    assert {one.name for one in report if one.outcome == "skip"} == {"consistency"}


def test_a_derivative_between_corners_that_lie_close_together_is_no_wrong_one():
    def folded(output, batch):
        log_sigma = 0.5 * jnp.log(output.cov[0])
        fold = 1e-4 * jnp.abs(log_sigma / 1e-4 - jnp.round(log_sigma / 1e-4))
        return output._replace(log_likelihood=output.log_likelihood + 0.05 * fold)

    found = {str(c): c for c in tw.tracker_checks(averaged(folded), recordings())}["gradient"].result
    assert (found.outcome, found.sentence) == ("pass", "2 tunables"), found


def test_a_tracker_that_reads_inputs_or_is_no_filter_needs_recordings():
    with pytest.raises(tw.UnusableInput, match="found a Averaged; expected recordings"):
        tw.check_tracker(averaged())
    with pytest.raises(
        tw.UnusableInput, match=r"found a Tracker of the inputs height.*; usual fix: check_tracker\(mine"
    ):
        tw.check_tracker(tw.fix_tracker(planar=True))
