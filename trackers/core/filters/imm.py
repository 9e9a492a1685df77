"""The interacting-multiple-model filter (Blom and Bar-Shalom 1988): one extended Kalman filter per mode.

    K  number of modes      μⱼ  probability of mode j               xⱼ, Pⱼ  Gaussian belief in mode j
    πⱼ  prior of mode j     κⱼ  exp(−rateⱼ·dt), probability that the mode does not switch in dt

The mode is a Markov process in continuous time: at a rate it is redrawn from the prior π, so that the transition over
dt follows from dt, and two steps are one long step. With one rate for all modes the transition matrix is
κ I + (1 − κ) 1πᵀ. Of the K² mixed estimates of Blom and Bar-Shalom K remain: mode j starts from itself and from the
mixture x̄, P̄ of all that switched, N(xᵢ, Pᵢ) with weights (1 − κᵢ) μᵢ, whose sum is φ:

    μⱼ⁻ = κⱼ μⱼ + φ πⱼ        aⱼ = φ πⱼ / μⱼ⁻        d = x̄ − xⱼ
    xⱼ ← (1 − aⱼ) xⱼ + aⱼ x̄        Pⱼ ← (1 − aⱼ) Pⱼ + aⱼ P̄ + aⱼ (1 − aⱼ) ddᵀ

Motions and sensors that depend on the mode have `in_mode`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter, Innovation
from trackwright.trackers.core.filters.rts import RtsGain
from trackwright.trackers.core.model.algebra import Scalar, Vector, compute_once, total
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian, matched
from trackwright.trackers.core.model.inputs import Input, Inputs, RawKey
from trackwright.trackers.core.model.motion import AbstractMotion, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading
from trackwright.trackers.core.model.state import State, local, retract
from trackwright.trackers.core.model.tunable import Scale


class Mixture(NamedTuple):
    """A belief: one Gaussian per mode, and the logarithms of the modes' probabilities."""

    components: tuple[Gaussian, ...]
    log_weights: tuple[Scalar, ...]


class ModeTransition(NamedTuple):
    """Mode transition over dt: predicted probabilities μ⁻, the parts of μ that stayed or switched, and their sum φ."""

    predicted: list[Scalar]
    stayed: list[Scalar]
    switched: list[Scalar]
    total_switched: Scalar


class ModeGains(NamedTuple):
    """RTS gains between modes: `gains` (…, pairs, B) from mode i to mode j of the next time step, by j, then i.

    `backward` (K, K, B): P(mode i now | mode j at the next step). Where the motion is the same in all modes, `gains`
    has one j. `connected`: whether the next step continues the track.
    """

    filtered: Mixture
    gains: RtsGain
    backward: jax.Array
    connected: Scalar


class AbstractSwitching(eqx.Module):
    """A motion or a sensor that depends on the mode."""

    @abstractmethod
    def in_mode(self, mode: int) -> Any:
        """The motion or the sensor of a mode, counted from 0."""


class SwitchingMotion(AbstractMotion, AbstractSwitching):
    """One motion per mode, all of one kind of state; a filter without modes uses the first."""

    modes: tuple[AbstractMotion, ...]

    @property
    def noise_dimension(self) -> int:
        return self.modes[0].noise_dimension

    def step(self, state: State, inputs: Inputs, dt: Scalar, w: Vector) -> State:
        return self.modes[0].step(state, inputs, dt, w)

    def view(self, state: State) -> Any:
        return self.modes[0].view(state)

    @property
    def inputs(self) -> tuple[Input, ...]:
        return self.modes[0].inputs

    def in_mode(self, mode: int) -> AbstractMotion:
        return self.modes[mode]


class AbstractInteractingModels(AbstractSmoothableFilter[Mixture]):
    """An interacting-multiple-model filter with the mode transition of the module's head.

    `switching_rate`: 1/s. `mode_prior` (K,): the modes' long-run probabilities, up to a factor. Estimates are the
    mixture's mean and covariance; the log-likelihood is the mixture's; the NIS is the probability-weighted mean of the
    modes' NIS.
    """

    switching_rate: eqx.AbstractVar[Noise]
    mode_prior: eqx.AbstractVar[Noise]
    filter: eqx.AbstractVar[ExtendedKalman]

    @abstractmethod
    def switching_rates(self, belief: Mixture, inputs: Inputs) -> list[Scalar]:
        """The switching rate of each mode, 1/s."""

    def prior(self) -> list[Scalar]:
        """The modes' long-run probabilities π, with sum 1."""
        factors = [self.mode_prior.value[k] for k in range(self.mode_prior.value.shape[0])]
        norm = total(factors)
        return [x / norm for x in factors]

    def init(self, belief: Gaussian, key: RawKey) -> Mixture:
        """All modes at the same Gaussian, with their prior probabilities; `key` is unused."""
        prior = self.prior()
        zero = jnp.zeros_like(belief.cov[0])
        return Mixture((belief,) * len(prior), tuple(jnp.log(p) + zero for p in prior))

    def moments(self, belief: Mixture) -> tuple[State, AnyCovariance]:
        """The mean and covariance of the mixture."""
        return collapsed(belief.components, [jnp.exp(w) for w in belief.log_weights])

    def transition(self, belief: Mixture, inputs: Inputs, dt: Scalar) -> ModeTransition:
        """The mode transition over `dt` s."""
        # Its square still has a finite inverse, which the derivative of a quotient needs.
        tiny = float(jnp.finfo(dt.dtype).tiny) ** 0.5
        weights = [jnp.exp(w) for w in belief.log_weights]
        rates = self.switching_rates(belief, inputs)
        stayed = [w * jnp.exp(-rate * dt) for rate, w in zip(rates, weights, strict=True)]
        switched = [-jnp.expm1(-rate * dt) * w for rate, w in zip(rates, weights, strict=True)]
        total_switched = jnp.maximum(total(switched), tiny)
        predicted = [jnp.maximum(k + total_switched * p, tiny) for k, p in zip(stayed, self.prior(), strict=True)]
        return ModeTransition(predicted, stayed, switched, total_switched)

    def predict(self, belief: Mixture, motion: AbstractMotion, inputs: Inputs, dt: Scalar) -> Mixture:
        """The belief `dt` s later: mixing of the modes, then each mode's prediction."""
        transition = self.transition(belief, inputs, dt)
        weights = [x / transition.total_switched for x in transition.switched]
        switched = compute_once(collapsed(belief.components, weights))
        components = []
        for mode, prior in enumerate(self.prior()):
            share = transition.total_switched * prior / transition.predicted[mode]
            mixed = compute_once(collapsed((belief.components[mode], switched), [1.0 - share, share]))
            components.append(self.filter.predict(mixed, _in_mode(motion, mode), inputs, dt))
        return Mixture(tuple(components), tuple(jnp.log(x) for x in transition.predicted))

    def update(
        self, belief: Mixture, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Inputs
    ) -> tuple[Mixture, Innovation]:
        """The belief after one reading, and the reading's `Innovation`."""
        updated = [
            self.filter.update(component, _in_mode(motion, mode), _in_mode(sensor, mode), reading, inputs)
            for mode, component in enumerate(belief.components)
        ]
        joint = [w + innovation.log_likelihood for w, (_, innovation) in zip(belief.log_weights, updated, strict=True)]
        top = joint[0]
        for x in joint[1:]:
            top = jnp.maximum(top, x)
        log_likelihood = compute_once(top + jnp.log(total(jnp.exp(x - top) for x in joint)))
        log_weights = tuple(x - log_likelihood for x in joint)
        nis = total(jnp.exp(w) * innovation.nis for w, (_, innovation) in zip(log_weights, updated, strict=True))
        first = updated[0][1]
        innovation = Innovation(log_likelihood, nis, first.nis_dof, first.wrapped)
        return Mixture(tuple(g for g, _ in updated), log_weights), innovation

    def rts_gain(
        self, belief: Mixture, motion: AbstractMotion, connected: Scalar, dt: Scalar, inputs: Inputs
    ) -> ModeGains:
        """The RTS gains to the next time step, from every mode to every mode."""
        transition = jax.vmap(self.transition, in_axes=-1, out_axes=-1)(belief, inputs, dt)
        prior = self.prior()
        pairs = list(zip(transition.stayed, transition.switched, strict=True))
        backward = jnp.stack(
            [
                jnp.stack([((a if i == j else 0.0) + b * p) / transition.predicted[j] for j, p in enumerate(prior)])
                for i, (a, b) in enumerate(pairs)
            ]
        )
        motions = [motion.in_mode(j) for j in range(len(prior))] if isinstance(motion, AbstractSwitching) else [motion]
        # Pairs of modes take the place of trajectories: with arrays (K, K, n, n, B) a step takes a third longer.
        known = [_side_by_side([x] * len(prior)) for x in (connected, dt, inputs)]
        modes = _side_by_side(belief.components)
        gains = _side_by_side([self.filter.rts_gain(modes, later, *known) for later in motions])
        return ModeGains(belief, _apart(gains, len(motions) * len(prior)), backward, connected)

    def rts_step(self, rts_gain: ModeGains, after: Mixture) -> Mixture:
        """The smoothed belief of a time step, given the next one's (Kim 1994).

        Each mode is the collapsed mixture of its smoothed Gaussians over the next step's modes. Kim's approximation:
        P(mode now | mode at the next step) is taken from measurements up to now alone; exact only without switching.
        """
        K = len(after.components)
        tiny = float(jnp.finfo(after.log_weights[0].dtype).tiny) ** 0.5
        # `tiny`: a mode without a successor continues unchanged, so that its weights still have sum 1.
        joint = [
            p * jnp.exp(w)[None] + tiny * (np.arange(K) == j)[:, None]
            for j, (p, w) in enumerate(zip(rts_gain.backward.swapaxes(0, 1), after.log_weights, strict=True))
        ]
        probability = compute_once(total(joint))
        weights = [_together(x / probability) for x in joint]
        gains = _together(rts_gain.gains)
        if rts_gain.gains.connected.shape[0] == K:
            later = _collapsed_beside([_side_by_side([x] * K) for x in after.components], weights)
            smoothed = self.filter.rts_step(gains, later)
        else:
            later = _side_by_side([x for x in after.components for _ in range(K)])
            smoothed = _collapsed_beside(_parts(compute_once(self.filter.rts_step(gains, later)), K), weights)
        components = _parts(compute_once(smoothed), K)
        log_weights = [
            jnp.where(rts_gain.connected, jnp.log(p), w)
            for p, w in zip(probability, rts_gain.filtered.log_weights, strict=True)
        ]
        return Mixture(tuple(components), tuple(log_weights))


class InteractingModels(AbstractInteractingModels):
    """The interacting-multiple-model filter with one switching rate, 1/s, for all modes."""

    switching_rate: Noise
    mode_prior: Noise
    filter: ExtendedKalman

    def __init__(self, switching_rate: float, mode_prior: Sequence[float]):
        self.filter = ExtendedKalman()
        self.switching_rate, self.mode_prior = Scale(switching_rate, "1/s"), Scale(np.asarray(mode_prior, float))

    def switching_rates(self, belief: Mixture, inputs: Inputs) -> list[Scalar]:
        return [self.switching_rate.value] * len(belief.components)


def collapsed(components: Sequence[Gaussian], weights: Sequence[Scalar]) -> Gaussian:
    """The moment-matched Gaussian of a mixture with weights of sum 1."""
    mean, deviations = mean_and_deviations([g.mean for g in components], weights)
    return Gaussian(mean, matched(weights, [g.cov for g in components], deviations))


def _collapsed_beside(components: Sequence[Gaussian], weights: Sequence[Any]) -> Gaussian:
    """`collapsed` of all trajectories, last in every array, with covariances (n, n, B)."""
    means = [g.mean for g in components]
    mean, deviations = jax.vmap(mean_and_deviations, in_axes=-1, out_axes=-1)(means, list(weights))
    return Gaussian(mean, matched(weights, [g.cov for g in components], deviations))


def mean_and_deviations(means: Sequence[State], weights: Sequence[Scalar]) -> tuple[State, list[Sequence[Scalar]]]:
    """The mean of a mixture, and the small steps from it to the means of its components."""
    steps = [local(means[0], x) for x in means[1:]]
    mean_step = [total(w * s for w, s in zip(weights[1:], column, strict=True)) for column in zip(*steps, strict=True)]
    mean = retract(means[0], mean_step) if mean_step else means[0]
    return mean, [local(mean, x) for x in means]


def _side_by_side(trees: Sequence[Any]) -> Any:
    """Trees of trajectories, last in every array, as one of all their trajectories."""
    return jax.tree_util.tree_map(lambda *x: jnp.concatenate(x, axis=-1), *trees)


def _apart(tree: Any, number: int) -> Any:
    """A tree of `number` parts side by side with the parts as the last axis but one."""
    return jax.tree_util.tree_map(lambda x: x.reshape(*x.shape[:-1], number, -1), tree)


def _together(tree: Any) -> Any:
    """The inverse of `_apart`."""
    return jax.tree_util.tree_map(lambda x: x.reshape(*x.shape[:-2], -1), tree)


def _parts(tree: Any, number: int) -> list[Any]:
    """The `number` parts of a tree side by side."""
    parts = _apart(tree, number)
    return [jax.tree_util.tree_map(lambda x, k=k: x[..., k, :], parts) for k in range(number)]


def _in_mode(part: Any, mode: int) -> Any:
    return part.in_mode(mode) if isinstance(part, AbstractSwitching) else part
