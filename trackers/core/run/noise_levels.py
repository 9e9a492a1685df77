"""Several levels of noise side by side, weighted by the likelihoods of the recording's own readings.

Multiple-model adaptive estimation (Magill 1965; Bar-Shalom, Li and Kirubarajan 2001, section 11.6), with weights that
change over time. A tracker that is tuned for hand-held tags is wrong by an order of magnitude for a slow trolley, and
the anchors of one site err several times as much as those of another; the readings tell. But their errors last, so that
readings within `lasting` seconds count as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Self

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
from trackwright.trackers.core.model.state import local
from trackwright.trackers.core.model.tunable import Scale, replaced, role_of, tunables
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, Tracker

Weights = Float[Array, "K T B"]


class Level(NamedTuple):
    """Factors on a tracker's noise levels, and the probability of the level before any reading.

    `motion`, `vertical`: on the process noise of the axes `horizontal` and `vertical`. `biases`: on the standard
    deviation of the biases. `readings`: on the measurement noise.
    """

    prior: float
    motion: float = 1.0
    vertical: float = 1.0
    biases: float = 1.0
    readings: float = 1.0


MOTION = (Level(0.9), *(Level(0.1 / 3, motion=factor) for factor in (0.2, 0.04, 0.008)))
"""From a hand to a trolley that hardly moves."""

VERTICAL = (Level(0.9), *(Level(0.05, vertical=factor) for factor in (0.2, 0.04)))
"""From a hand or a drone that climbs to a body that keeps its height."""

ERRORS = (Level(1 / 3), Level(1 / 3, biases=0.5, readings=0.25), Level(1 / 3, biases=2.0, readings=0.25))
"""The given levels, which are robust to errors that come and go within seconds, and readings with the white noise of a
receiver (2 cm of ranges) and biases of half and twice the size, an octave being what sites differ by."""


class NoiseLevels(AbstractEpochwiseTracker):
    """A tracker at K levels of noise; estimates are the moments of their mixture.

    `levels`: the first is that of the estimates where no other has a track. `about_first`: the mean stays that of the
    first member, and the covariance is the mean square of its errors under the mixture. The weight of a member follows
    its likelihood, each row's to the power 1/c with c the number of rows with readings in the last `lasting` s, whose
    errors last, and returns to the prior with the time constant `memory` s: a hidden Markov model of the level, whose
    smoother weighs smoothed members. The log-likelihood is that of the mixture's prediction, NIS and status those of
    weighted members, `about_first` the status of the first. Raises UnusableInput for a tracker without such a noise
    level.
    """

    tracker: Tracker | Smoothed | NoiseLevels
    levels: tuple[Level, ...] = eqx.field(static=True, default=MOTION)
    about_first: bool = eqx.field(static=True, default=False)
    lasting: float = eqx.field(static=True, default=3.0)
    memory: float = eqx.field(static=True, default=100.0)

    def __check_init__(self) -> None:
        scaled_levels(self.tracker, self.levels)

    def check_layout(self, layout: Layout) -> None:
        self.tracker.check_layout(layout)

    def for_positions(self) -> Self:
        return replace(self, tracker=self.tracker.for_positions())

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return self.tracker.nis_sensors

    @property
    def whole(self) -> bool:
        """Whether estimates depend on all later rows."""
        one = self.tracker
        return one.whole if isinstance(one, NoiseLevels) else isinstance(one, Smoothed) and one.lag is None

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        scaled = scaled_levels(self.tracker, self.levels)

        def member(factors: Mapping[str, Scalar], state: Any) -> tuple[Output, Any]:
            nodes = {name: node.with_value(node.value * factors[name]) for name, (node, _) in scaled.items()}
            return replaced(self.tracker, nodes).scan(batch, state)

        valid = jnp.asarray(batch.valid)
        dt = jnp.where(valid, batch.dt, 0.0)
        factors = {name: jnp.asarray(of_levels, dt.dtype) for name, (_, of_levels) in scaled.items()}
        states, log_weights, count = (None, *self._before(batch.size, dt.dtype)) if initial is None else initial
        # Trajectories are first in every array of a state.
        members = jax.vmap(member, in_axes=(0, None if initial is None else 1), out_axes=(0, 1))
        outputs, states = members(factors, states)
        returned, prior = -jnp.expm1(-dt / self.memory), self._prior(dt.dtype)
        power, count = _powers(outputs.nis_dof[0] > 0, dt / self.lasting, count)
        evidence = power[None] * outputs.log_likelihood
        predicted, log_weights = _forward(evidence, returned, prior, log_weights.T, valid)
        log_likelihood = jax.nn.logsumexp(predicted + outputs.log_likelihood, axis=0)
        weights = jax.nn.softmax(predicted + evidence, axis=0)
        if self.whole:
            weights = _smoothed(weights, evidence, returned, prior)
        output = mixture_of(outputs, weights, self.about_first)._replace(log_likelihood=log_likelihood)
        return output, (states, log_weights.T, count)

    def begin(self, prior: Gaussian, batch: Batch) -> Any:
        state, members = self.tracker.begin(prior, batch), len(self.levels)
        states = jax.tree_util.tree_map(lambda x: jnp.stack([jnp.asarray(x)] * members, axis=1), state)
        return states, *self._before(batch.size, jnp.asarray(batch.dt).dtype)

    def _before(self, size: int, dtype: Any) -> tuple[jax.Array, jax.Array]:
        """Logarithms of the weights (B, K) before the first row, and the number of rows that count as one (B,)."""
        return jnp.tile(jnp.log(self._prior(dtype)).T, (size, 1)), jnp.zeros(size, dtype)

    def _prior(self, dtype: Any) -> Float[Array, "K 1"]:
        return jnp.asarray([[level.prior] for level in self.levels], dtype)


def levels_of_motion(tracker: Any, planar: bool) -> tuple[Level, ...]:
    """The levels of horizontal motion, with each of the vertical one unless `planar` or without process noise of it."""
    if planar or not _named(tunables(tracker), "process noise", "vertical"):
        return MOTION
    return tuple(h._replace(prior=h.prior * v.prior, vertical=v.vertical) for v in VERTICAL for h in MOTION)


def _named(nodes: Mapping[str, Any], role: str, axis: str | None = None) -> list[str]:
    """The names of the noise levels of a role, and of an axis alone where one is given."""
    return [
        name
        for name, node in nodes.items()
        if isinstance(node, Scale) and role_of(node) == role and axis in (None, node.axis)
    ]


def scaled_levels(tracker: Any, levels: tuple[Level, ...]) -> dict[str, tuple[Scale, list[float]]]:
    """The noise levels that differ between levels, by name, each with its factors; raises UnusableInput without any."""
    nodes = {name: node for name, node in tunables(tracker).items() if isinstance(node, Scale)}
    kinds = {
        "motion": _named(nodes, "process noise", "horizontal"),
        "vertical": _named(nodes, "process noise", "vertical"),
        "biases": [n for n in nodes if n.rpartition(".")[2] == "sigma_bias"],
        "readings": _named(nodes, "measurement noise"),
    }
    scaled: dict[str, tuple[Scale, list[float]]] = {}
    for kind, names in kinds.items():
        factors = [getattr(level, kind) for level in levels]
        if len(set(factors)) == 1:
            continue
        if not names:
            raise UnusableInput(f"levels of {KINDS[kind]}, as of `uwb`; leave them out (--motion auto, --errors auto)")
        scaled |= {name: (nodes[name], factors) for name in names}
    return scaled


KINDS = {
    "motion": "motion: this tracker has no process noise of the horizontal motion; expected one",
    "vertical": "motion: this tracker has no process noise of the vertical motion; expected one",
    "biases": "errors: this tracker has no biases that drift; expected them",
    "readings": "errors: this tracker has no level of the noise of its readings; expected one",
}
"""The levels of each kind, and what a tracker without them lacks, in words."""


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
    evidence: Weights,
    returned: Float[Array, "T B"],
    prior: Float[Array, "K 1"],
    before: Float[Array, "K B"],
    valid: Bool[Array, "T B"],
) -> tuple[Weights, Float[Array, "K B"]]:
    """The logarithms of the weights before each row, and after the last one.

    `evidence`: logarithms of likelihoods. `returned`: the share of the weights that returns to the prior before a row.
    """

    def row(log_weights: jax.Array, row: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        evidence, returned, valid = row[0], row[1][None], row[2]
        predicted = jnp.logaddexp(log_weights + jnp.log1p(-returned), jnp.log(prior * returned + 1e-30))
        # Rows of padding would normalise the weights anew, which moves last bits.
        return jnp.where(valid, jax.nn.log_softmax(predicted + evidence, axis=0), log_weights), predicted

    after, predicted = jax.lax.scan(row, before, (jnp.moveaxis(evidence, 0, 1), returned, valid))
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


def mixture_of(outputs: Output, weights: Weights, about_first: bool = False) -> Output:
    """The moments of the members that have a track; those of the first where none has. `outputs`: members first.

    `about_first`: the mean is that of the first member, and the covariance is about it.
    """
    usable = (outputs.status == Status.OK) | (outputs.status == Status.RESTARTED)
    shares = jnp.where(usable & (usable[:1] if about_first else True), weights, 0.0)
    sums = jnp.sum(shares, axis=0, keepdims=True)
    first = (jnp.arange(len(weights)) == 0)[:, None, None]
    shares = jnp.where(sums > 0, shares / jnp.where(sums > 0, sums, 1.0), first.astype(shares.dtype))
    likeliest = jnp.argmax(shares, axis=0)[None]
    kept = (shares > 0) | first if about_first else shares > 0
    status = outputs.status[0] if about_first else jnp.take_along_axis(outputs.status, likeliest, axis=0)[0]

    def known(x: jax.Array) -> jax.Array:
        """A leaf (K, T, …, B) of the moments, of members without a track that of the likeliest one."""
        shape = x.shape[1], *(1,) * (x.ndim - 3), x.shape[-1]
        instead = jnp.take_along_axis(x, likeliest.reshape(1, *shape), axis=0)
        return jnp.where(kept.reshape(-1, *shape), x, instead)

    moments = jax.tree_util.tree_map(known, (outputs.mean, outputs.cov))
    members = [jax.tree_util.tree_map(lambda x, k=k: x[k], moments) for k in range(len(weights))]
    centre = jax.vmap(jax.vmap(_about_first if about_first else mean_and_deviations, in_axes=-1, out_axes=-1))
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
        status,
        None if outputs.age is None else outputs.age[0],
    )


def _about_first(means: list[Any], weights: list[Scalar]) -> tuple[Any, list[Any]]:
    """As `mean_and_deviations`, about the mean of the first component."""
    return means[0], [local(means[0], x) for x in means]
