"""A sound tracker of one's own passes all checks, and one with a fault fails the check of that fault with its fix."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

import trackwright as tw
from tests.trackers.conformance.own_trackers import (
    AtTheFirst,
    CountedTwice,
    Unsettled,
    averaged,
    kalman,
    recordings,
)


def _and(add):
    """A change of the output: `add(output, batch)` more in the NIS of each row and trajectory."""
    return lambda output, batch: output._replace(nis=output.nis + add(output, batch))


def _of_padding(output, batch):
    return jnp.max(jnp.where(batch.valid, 0.0, batch.dt), axis=0)[None]


def _of_later_rows(output, batch):
    return jnp.flip(jnp.cumsum(jnp.flip(jnp.where(batch.valid, output.nis, 0.0), 0), axis=0), 0)


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
    "run: finite": (
        lambda: kalman(change=lambda r, z: r._replace(log_scale=r.log_scale / (z.values[0] - z.values[0]))),
        {"run"},
        "row .* of recording 0 is not finite; usual fix: check_motion",
    ),
    "run": (lambda: kalman(start=Unsure()), {"run"}, "a track runs in 0% of the rows"),
}  # fmt: skip
"""By the check that finds it: a tracker with a fault, all checks that fail with it, and what the sentence says."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_by_its_check(name):
    tracker, _, message = FAULTS[name]
    check = next(c for c in tw.tracker_checks(tracker(), recordings()) if str(c) == name.partition(":")[0])
    with pytest.raises(tw.BrokenContract, match=message):
        check()


def test_sound_trackers_pass_all_checks():
    tw.check_tracker(kalman(), recordings(3))
    tw.check_tracker(averaged(), recordings(3))
