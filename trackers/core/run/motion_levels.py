"""Several levels of horizontal motion side by side, weighted by the likelihoods of the recording's own readings.

Multiple-model adaptive estimation (Magill 1965; Bar-Shalom, Li and Kirubarajan 2001, section 11.6), with weights that
change over time. A tracker that is tuned for hand-held tags is wrong by an order of magnitude for a slow trolley, and
the readings tell; but errors of readings last, so that those within `lasting` seconds count as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.filters.imm import mean_and_deviations
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.covariance import Gaussian, matched, size_of
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.tunable import Scale, replaced, role_of, tunables
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker

Weights = Float[Array, "K T B"]


class MotionLevels(AbstractEpochwiseTracker):
    """A tracker at K levels of horizontal motion; estimates are the moments of their mixture.

    `factors`: member k has the process noise of the axis `horizontal` times `factors[k]`; from a hand to a trolley that
    hardly moves. `prior`: probability of the first member before any reading, of which the others share the rest. The
    weight of a member follows its likelihood, each row's to the power 1/c with c the number of rows with readings in
    the last `lasting` s, whose errors last, and returns to the prior with the time constant `memory` s: a hidden Markov
    model of the level, whose smoother weighs smoothed members. The log-likelihood is that of the mixture's prediction,
    NIS and status those of weighted members. Raises UnusableInput for a tracker without such a noise level.
    """

    tracker: Tracker | Smoothed
    factors: tuple[float, ...] = eqx.field(static=True, default=(1.0, 0.2, 0.04, 0.008))
    prior: float = eqx.field(static=True, default=0.9)
    lasting: float = eqx.field(static=True, default=3.0)
    memory: float = eqx.field(static=True, default=100.0)

    def __check_init__(self) -> None:
        levels_of_motion(self.tracker)

    def check_layout(self, layout: Layout) -> None:
        self.tracker.check_layout(layout)

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return self.tracker.nis_sensors

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        levels = levels_of_motion(self.tracker)

        def member(factor: Scalar, state: Any) -> tuple[Output, Any]:
            scaled = {name: node.with_value(node.value * factor) for name, node in levels.items()}
            return replaced(self.tracker, scaled).scan(batch, state)

        dt = jnp.where(jnp.asarray(batch.valid), batch.dt, 0.0)
        factors = jnp.asarray(self.factors, dt.dtype)
        states, log_weights, count = (None, *self._before(batch.size, dt.dtype)) if initial is None else initial
        # Trajectories are first in every array of a state.
        members = jax.vmap(member, in_axes=(0, None if initial is None else 1), out_axes=(0, 1))
        outputs, states = members(factors, states)
        returned, prior = -jnp.expm1(-dt / self.memory), self._prior(dt.dtype)
        power, count = _powers(outputs.nis_dof[0] > 0, dt / self.lasting, count)
        evidence = power[None] * outputs.log_likelihood
        predicted, log_weights = _forward(evidence, returned, prior, log_weights.T)
        log_likelihood = jax.nn.logsumexp(predicted + outputs.log_likelihood, axis=0)
        weights = jax.nn.softmax(predicted + evidence, axis=0)
        if isinstance(self.tracker, Smoothed) and self.tracker.lag is None:
            weights = _smoothed(weights, evidence, returned, prior)
        output = mixture_of(outputs, weights)._replace(log_likelihood=log_likelihood)
        return output, (states, log_weights.T, count)

    def begin(self, prior: Gaussian, batch: Batch) -> Any:
        state, members = self.tracker.begin(prior, batch), len(self.factors)
        states = jax.tree_util.tree_map(lambda x: jnp.stack([jnp.asarray(x)] * members, axis=1), state)
        return states, *self._before(batch.size, jnp.asarray(batch.dt).dtype)

    def _before(self, size: int, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """Logarithms of the weights (B, K) before the first row, and the number of rows that count as one (B,)."""
        return jnp.tile(jnp.log(self._prior(dtype)).T, (size, 1)), jnp.zeros(size, dtype)

    def _prior(self, dtype: Any) -> Float[Array, "K 1"]:
        others = len(self.factors) - 1
        return jnp.asarray([[self.prior]] + [[(1.0 - self.prior) / others]] * others, dtype)


def levels_of_motion(tracker: Any) -> Mapping[str, Scale]:
    """The levels of horizontal process noise of a tracker, by name; raises UnusableInput where there is none."""
    levels = {
        name: node
        for name, node in tunables(tracker).items()
        if isinstance(node, Scale) and role_of(node) == "process noise" and node.axis == "horizontal"
    }
    if not levels:
        raise UnusableInput(
            "levels of motion: this tracker has no process noise of the horizontal motion; expected one, as of `uwb`; "
            "run it as it is"
        )
    return levels


def _powers(
    seen: Bool[Array, "T B"], elapsed: Float[Array, "T B"], count: Float[Array, " B"]
) -> tuple[Float[Array, "T B"], Float[Array, " B"]]:
    """The power of each row's likelihood, and the number of rows that count as one after the last.

    `elapsed`: the time to each row in units of that within which readings count as one.
    """

    def row(count: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        seen, elapsed = row
        count = count * jnp.exp(-elapsed) + seen.astype(elapsed.dtype)
        return count, jnp.where(seen, 1.0 / jnp.maximum(count, 1.0), 0.0)

    count, power = jax.lax.scan(row, count, (seen, elapsed))
    return power, count


def _forward(
    evidence: Weights, returned: Float[Array, "T B"], prior: Float[Array, "K 1"], before: Float[Array, "K B"]
) -> tuple[Weights, Float[Array, "K B"]]:
    """The logarithms of the weights before each row, and after the last one.

    `evidence`: logarithms of likelihoods. `returned`: the share of the weights that returns to the prior before a row.
    """

    def row(log_weights: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        evidence, returned = row[0], row[1][None]
        predicted = jnp.logaddexp(log_weights + jnp.log1p(-returned), jnp.log(prior * returned + 1e-30))
        return jax.nn.log_softmax(predicted + evidence, axis=0), predicted

    after, predicted = jax.lax.scan(row, before, (jnp.moveaxis(evidence, 0, 1), returned))
    return jnp.moveaxis(predicted, 0, 1), after


def _smoothed(
    weights: Weights, evidence: Weights, returned: Float[Array, "T B"], prior: Float[Array, "K 1"]
) -> Weights:
    """The weights given all rows: the forward-backward recursion (Rabiner 1989); arguments as of `_forward`."""

    def row(later: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        evidence, returned = row[0], row[1][None]
        joint = later * jnp.exp(evidence - jnp.max(evidence, axis=0, keepdims=True))
        earlier = (1.0 - returned) * joint + returned * jnp.sum(prior * joint, axis=0, keepdims=True)
        return earlier / jnp.max(earlier, axis=0, keepdims=True), later

    rows = jnp.moveaxis(evidence, 0, 1), returned
    _, later = jax.lax.scan(row, jnp.ones_like(weights[:, 0]), rows, reverse=True)
    joint = weights * jnp.moveaxis(later, 0, 1)
    return joint / jnp.sum(joint, axis=0, keepdims=True)


def mixture_of(outputs: Output, weights: Weights) -> Output:
    """The moments of the members that have a track; those of the first where none has. `outputs`: members first."""
    usable = (outputs.status == Status.OK) | (outputs.status == Status.RESTARTED)
    shares = jnp.where(usable, weights, 0.0)
    sums = jnp.sum(shares, axis=0, keepdims=True)
    first = (jnp.arange(len(weights)) == 0)[:, None, None]
    shares = jnp.where(sums > 0, shares / jnp.where(sums > 0, sums, 1.0), first.astype(shares.dtype))
    likeliest = jnp.argmax(shares, axis=0)[None]

    def known(x: jax.Array) -> jax.Array:
        """A leaf (K, T, …, B) of the moments, of members without a track that of the likeliest one."""
        shape = x.shape[1], *(1,) * (x.ndim - 3), x.shape[-1]
        instead = jnp.take_along_axis(x, likeliest.reshape(1, *shape), axis=0)
        return jnp.where((shares > 0).reshape(-1, *shape), x, instead)

    moments = jax.tree_util.tree_map(known, (outputs.mean, outputs.cov))
    members = [jax.tree_util.tree_map(lambda x, k=k: x[k], moments) for k in range(len(weights))]
    centre = jax.vmap(jax.vmap(mean_and_deviations, in_axes=-1, out_axes=-1))
    mean, deviations = centre([member for member, _ in members], list(shares))
    covs, size = [cov for _, cov in members], size_of(outputs.cov)
    return Output(
        mean,
        # A covariance may be that of the leading components alone.
        matched(list(shares), covs, [d[:size] for d in deviations]),
        outputs.log_likelihood[0],
        jnp.sum(weights * outputs.nis, axis=0),
        outputs.nis_dof[0],
        outputs.wrapped[0],
        jnp.take_along_axis(outputs.status, likeliest, axis=0)[0],
        None if outputs.age is None else outputs.age[0],
    )
