"""A sound tracker of one's own passes all checks, and one with a fault fails the check of that fault with its fix."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.conformance.trackers import tracker_checks
from trackwright.trackers.core.model.motion import Placed
from trackwright.trackers.core.model.sensor import LOG_2PI
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, AbstractTracker


def _recordings(count: int = 1, rows: int = 40) -> list[tw.Recording]:
    """Positions near a straight walk, m."""
    rng, times = np.random.default_rng(5), 0.1 * np.arange(rows)
    walk = np.stack([0.5 * times, 1.0 - 0.3 * times], axis=1)
    shape = (rows, 2)
    return [
        tw.Recording(times, {"places": tw.Readings(walk + 0.2 * rng.normal(size=shape), np.ones(shape, bool))})
    ] * count


def _plain(output: Output, batch: tw.Batch) -> Output:
    return output


class Averaged(AbstractEpochwiseTracker):
    """A running average of positions: a tracker that is not made of a motion and sensors, which a test alters."""

    share: tw.Fraction
    sigma: tw.Scale
    change: Callable[[Output, tw.Batch], Output] = eqx.field(static=True, default=_plain)
    forgets: bool = eqx.field(static=True, default=False)
    held: bool = eqx.field(static=True, default=False)
    label: Any = None

    def check_layout(self, layout):
        layout.check_readings("Averaged", "places", 2)

    def scan(self, batch, initial=None):
        reading = batch.readings["places"]
        seen = jnp.asarray(reading.seen) & jnp.asarray(batch.valid)[:, None]
        values = jnp.where(seen, reading.values, 0.0)
        if initial is None or self.forgets:
            before = (jnp.zeros_like(values[0]), jnp.zeros_like(seen[0]))
        else:
            before = tuple(jnp.moveaxis(jnp.asarray(x), 0, -1) for x in initial)

        sigma = jax.lax.stop_gradient(self.sigma.value) if self.held else self.sigma.value

        def step(carry, row):
            (mean, known), (value, there) = carry, row
            moved = jnp.where(known, mean + self.share.value * (value - mean), value)
            off = jnp.where(there & known, (value - mean) / sigma, 0.0)
            density = jnp.where(there & known, -0.5 * off**2 - jnp.log(sigma) - 0.5 * LOG_2PI, 0.0)
            mean, known = jnp.where(there, moved, mean), known | there
            return (mean, known), (mean, known.all(axis=0), density.sum(axis=0), (off**2).sum(axis=0))

        after, (mean, known, log_likelihood, nis) = jax.lax.scan(step, before, (values, seen))
        zero = jnp.zeros_like(nis)
        variance = zero + self.sigma.value**2
        status = jnp.where(batch.valid, jnp.where(known, tw.Status.OK, tw.Status.WAITING), tw.Status.PADDING)
        output = Output(
            Placed(tw.Vector(mean[:, 0], mean[:, 1])), (variance, zero, variance),
            log_likelihood, nis, seen.sum(axis=1).astype(zero.dtype), zero, status.astype(jnp.int8),
        )  # fmt: skip
        return self.change(output, batch), tuple(jnp.moveaxis(x, -1, 0) for x in after)


class CountedTwice(AbstractTracker):
    """A tracker whose `accumulate` is not the sum of what its `scan` returns."""

    tracker: Averaged

    def check_layout(self, layout):
        self.tracker.check_layout(layout)

    def scan(self, batch, initial=None):
        return self.tracker.scan(batch, initial)

    def accumulate(self, batch, score, every_row=False):
        return tuple(2.0 * x for x in self.tracker.accumulate(batch, score, every_row))


@jax.tree_util.register_pytree_node_class
class Unsettled:
    """A label whose tree is another each time that it is flattened, so that no program is found again."""

    def tree_flatten(self):
        return (), object()

    @classmethod
    def tree_unflatten(cls, data, children):
        return cls()


def _averaged(change: Callable[[Output, tw.Batch], Output] = _plain, **facts: Any) -> Averaged:
    """The average with a function of its output and batch."""
    return Averaged(tw.Fraction(0.3), tw.Scale(0.3, "m"), change, **facts)


class Places(tw.AbstractSensor):
    """The position, m, with independent normal noise, whose residual a test changes."""

    sigma: tw.Scale
    change: Callable[[Any, Any], Any] = eqx.field(static=True, default=lambda residual, reading: residual)

    @property
    def channels(self):
        return tw.Channel("x", "m"), tw.Channel("y", "m")

    def measure(self, view, inputs):
        return list(view.position)

    def residual(self, reading, predicted):
        off = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        return self.change(tw.independent(off, [self.sigma.value] * 2, reading.seen), reading)


class AtTheFirst(tw.AbstractStart):
    """At rest, where the first reading is."""

    def can_start(self, row):
        return row.readings["places"].seen[0] & row.readings["places"].seen[1]

    def candidate(self, sensors, row):
        return row.readings["places"].values

    def belief(self, candidate, row):
        zero = 0.0 * candidate[0]
        state = tw.parts.Kinematic(tw.Vector(candidate[0], candidate[1]), tw.Vector(zero, zero))
        return tw.Gaussian(state, tw.diagonal([0.3**2, 0.3**2, 1.0, 1.0], zero))


def _kalman(**sensor: Any) -> tw.Tracker:
    """A linear tracker of positions."""
    places = Places(tw.Scale(0.2, "m", "measurement noise"), **sensor)
    return tw.Tracker(tw.parts.ConstantVelocity(0.5, 2), {"places": places}, AtTheFirst())


def _and(add):
    """A change of the output: `add(output, batch)` more in the NIS of each row and trajectory."""
    return lambda output, batch: output._replace(nis=output.nis + add(output, batch))


def _of_padding(output, batch):
    return jnp.max(jnp.where(batch.valid, 0.0, batch.dt), axis=0)[None]


def _of_later_rows(output, batch):
    return jnp.flip(jnp.cumsum(jnp.flip(jnp.where(batch.valid, output.nis, 0.0), 0), axis=0), 0)


def _of_the_number(output, batch):
    return jnp.mean(jnp.asarray(batch.valid)[0].astype(output.nis.dtype))


FAULTS = {
    "padding": (lambda: _averaged(_and(_of_padding)), "in rows of padding.*changes nis"),
    "later rows": (lambda: _averaged(_and(_of_later_rows)), "leaving out later rows"),
    "number and order": (
        lambda: _averaged(_and(_of_the_number)), r"a batch of the recordings \[0, 1, 2, 3, 4\] changes nis"
    ),
    "hidden values": (
        lambda: _kalman(change=lambda r, z: r._replace(
            log_scale=r.log_scale + 1e-3 * jnp.where(z.seen[0], 0.0, jnp.asarray(z.values[0]))
        )), "the value 1e\\+30 of a channel that is not seen changes log_likelihood",
    ),
    "cut and resume": (lambda: _averaged(forgets=True), "continues another from row .*`scan` returns"),
    "one program": (lambda: _averaged(label=Unsettled()), "traces [1-9].* programs anew, expected none"),
    "single and batch": (
        lambda: _averaged(lambda output, batch: output._replace(nis=output.nis * (1.0 + 1e-3 * batch.size))), "alone and in a batch differ",
    ),
    "accumulate": (lambda: CountedTwice(_averaged()), "by `accumulate`, .* by `scan`"),
    "gradient": (lambda: _averaged(held=True), "by sigma is 0, by difference quotients"),
}  # fmt: skip
"""By the check that finds it: a tracker with a fault, and what the sentence says."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_by_its_check(name):
    tracker, message = FAULTS[name]
    check = next(c for c in tracker_checks(tracker(), _recordings()) if str(c) == name.partition(":")[0])
    with pytest.raises(tw.BrokenContract, match=message):
        check()


@pytest.mark.slow
def test_sound_trackers_pass_all_checks():
    tw.check_tracker(_kalman(), _recordings(3))
    tw.check_tracker(_averaged(), _recordings(3))
