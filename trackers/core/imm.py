"""Interacting multiple models: one extended Kalman filter per mode, in which the target or its sensor may be.

    K  modes             μⱼ  probability of mode j                 xⱼ, Pⱼ  the normal belief in mode j
    πⱼ  long-run share   κⱼ  exp(−rateⱼ·dt), the chance that the mode was not drawn anew in dt

The mode is a Markov process in continuous time that is drawn anew from π at a rate, which knows dt and for which two
steps in a row are one long step: where all rates are one, its transition is κ I + (1 − κ) 1πᵀ. Of Blom and
Bar-Shalom's (1988) K² mixed estimates only K are then left to compute: mode j starts the row from itself and from the
mixture x̄, P̄ of all that is drawn anew, N(xᵢ, Pᵢ) by the weights (1 − κᵢ) μᵢ, whose sum is φ:

    μⱼ⁻ = κⱼ μⱼ + φ πⱼ        aⱼ = φ πⱼ / μⱼ⁻        d = x̄ − xⱼ
    xⱼ ← (1 − aⱼ) xⱼ + aⱼ x̄        Pⱼ ← (1 − aⱼ) Pⱼ + aⱼ P̄ + aⱼ (1 − aⱼ) ddᵀ

Motions and sensors that differ from mode to mode say so by `in_mode`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, compute_once, total, triangle
from trackers.core.ekf import ExtendedKalman, Gaussian, Innovation
from trackers.core.motion import AbstractMotion, Noise
from trackers.core.rts_step import RtsGain
from trackers.core.sensor import AbstractSensor, Reading
from trackers.core.state import State, local, retract
from trackers.core.tunable import Scale


class Mixture(NamedTuple):
    """A belief: a normal one for each mode, and the logarithms of the modes' probabilities."""

    components: tuple[Gaussian, ...]
    log_weights: tuple[Scalar, ...]


class Drawn(NamedTuple):
    """How the modes of a row become those of the next: probabilities there, and those of here kept and drawn anew."""

    after: list[Scalar]
    kept: list[Scalar]
    anew: list[Scalar]
    whole: Scalar


class ModeGains(NamedTuple):
    """What ties mode i of a row to mode j of the next: `chances[i][j]`, P(i here | j there), and `each[i][j]`.

    `each[i]` holds one link where the modes move alike.
    """

    filtered: Mixture
    each: tuple[tuple[RtsGain, ...], ...]
    chances: tuple[tuple[Scalar, ...], ...]
    joined: Scalar


class AbstractSwitching(eqx.Module):
    """A motion or a sensor that is another one in each mode."""

    @abstractmethod
    def in_mode(self, mode: int) -> Any:
        """The motion or the sensor of the mode, counted from 0."""


class SwitchingMotion(AbstractMotion, AbstractSwitching):
    """One motion per mode, all of one kind of state; a filter that knows no modes sees the first."""

    modes: tuple[AbstractMotion, ...]

    @property
    def noise_dimension(self) -> int:
        return self.modes[0].noise_dimension

    def step(self, state: State, inputs: Any, dt: Scalar, w: Vector) -> State:
        return self.modes[0].step(state, inputs, dt, w)

    def view(self, state: State) -> Any:
        return self.modes[0].view(state)

    def in_mode(self, mode: int) -> AbstractMotion:
        return self.modes[mode]


class InteractingModels(eqx.Module):
    """The interacting-multiple-model filter (Blom & Bar-Shalom 1988) with the transition of the module's head.

    `switching_rate`: draws of a new mode, 1/s. `mode_prior` (K,): the modes' long-run shares, in proportion. Estimates are the
    mixture's mean and covariance, the log-likelihood is the mixture's; NIS is the modes' mean by their probabilities.
    """

    switching_rate: Noise
    mode_prior: Noise
    filter: ExtendedKalman

    def __init__(self, switching_rate: float, mode_prior: Sequence[float]):
        self.filter = ExtendedKalman()
        self.switching_rate, self.mode_prior = Scale(switching_rate, "1/s"), Scale(np.asarray(mode_prior, float))

    def shares(self) -> list[Scalar]:
        """The modes' long-run probabilities."""
        odds = [self.mode_prior.value[k] for k in range(self.mode_prior.value.shape[0])]
        whole = total(odds)
        return [x / whole for x in odds]

    def rates(self, belief: Mixture, inputs: Any) -> list[Scalar]:
        """How often each mode is drawn anew, 1/s: here all at one rate."""
        return [self.switching_rate.value] * len(belief.components)

    def init(self, belief: Gaussian, key: Any) -> Mixture:
        """Every mode at the same belief, with its long-run probability."""
        shares = self.shares()
        zero = jnp.zeros_like(belief.cov[0])
        return Mixture((belief,) * len(shares), tuple(jnp.log(s) + zero for s in shares))

    def moments(self, belief: Mixture) -> tuple[State, tuple[Scalar, ...]]:
        """The mean and covariance of the mixture."""
        return merged(belief.components, [jnp.exp(w) for w in belief.log_weights])

    def drawn(self, belief: Mixture, inputs: Any, dt: Scalar) -> Drawn:
        """The modes' probabilities `dt` seconds later, and what they come of."""
        # Its square has an inverse still, which the derivative of a quotient takes.
        tiny = float(jnp.finfo(dt.dtype).tiny) ** 0.5
        weights = [jnp.exp(w) for w in belief.log_weights]
        rates = self.rates(belief, inputs)
        kept = [w * jnp.exp(-rate * dt) for rate, w in zip(rates, weights, strict=True)]
        anew = [-jnp.expm1(-rate * dt) * w for rate, w in zip(rates, weights, strict=True)]
        whole = jnp.maximum(total(anew), tiny)
        after = [jnp.maximum(k + whole * share, tiny) for k, share in zip(kept, self.shares(), strict=True)]
        return Drawn(after, kept, anew, whole)

    def predict(self, belief: Mixture, motion: AbstractMotion, inputs: Any, dt: Scalar) -> Mixture:
        """The belief `dt` seconds later, the modes mixed first."""
        drawn = self.drawn(belief, inputs, dt)
        mixture = compute_once(merged(belief.components, [x / drawn.whole for x in drawn.anew]))
        components = []
        for mode, share in enumerate(self.shares()):
            part = drawn.whole * share / drawn.after[mode]
            mixed = compute_once(merged((belief.components[mode], mixture), [1.0 - part, part]))
            components.append(self.filter.predict(mixed, _of(motion, mode), inputs, dt))
        return Mixture(tuple(components), tuple(jnp.log(x) for x in drawn.after))

    def update(
        self, belief: Mixture, motion: AbstractMotion, sensor: AbstractSensor, reading: Reading, inputs: Any
    ) -> tuple[Mixture, Innovation]:
        """The belief after one reading, and what the reading said."""
        found = [
            self.filter.update(component, _of(motion, mode), _of(sensor, mode), reading, inputs)
            for mode, component in enumerate(belief.components)
        ]
        joint = [w + said.log_likelihood for w, (_, said) in zip(belief.log_weights, found, strict=True)]
        top = joint[0]
        for x in joint[1:]:
            top = jnp.maximum(top, x)
        log_likelihood = compute_once(top + jnp.log(total(jnp.exp(x - top) for x in joint)))
        log_weights = tuple(x - log_likelihood for x in joint)
        nis = total(jnp.exp(w) * said.nis for w, (_, said) in zip(log_weights, found, strict=True))
        first = found[0][1]
        innovation = Innovation(log_likelihood, nis, first.nis_dof, first.wrapped)
        return Mixture(tuple(g for g, _ in found), log_weights), innovation

    def rts_gain(self, belief: Mixture, motion: AbstractMotion, joined: Scalar, dt: Scalar, inputs: Any) -> ModeGains:
        """What ties a row's belief to the next row's, every mode to every mode."""
        drawn, shares = self.drawn(belief, inputs, dt), self.shares()
        pairs = list(zip(drawn.kept, drawn.anew, strict=True))
        chances = tuple(
            tuple(((kept if i == j else 0.0) + anew * shares[j]) / drawn.after[j] for j in range(len(shares)))
            for i, (kept, anew) in enumerate(pairs)
        )
        motions = [motion.in_mode(j) for j in range(len(shares))] if isinstance(motion, AbstractSwitching) else [motion]
        each = tuple(
            tuple(self.filter.rts_gain(component, one, joined, dt, inputs) for one in motions)
            for component in belief.components
        )
        return ModeGains(belief, each, chances, joined)

    def rts_step(self, rts_gain: ModeGains, after: Mixture) -> Mixture:
        """The smoothed belief of a row, from the next row's (Kim, "Dynamic linear models with Markov-switching", 1994).

        Each mode is the mixture of what follows for it from every mode of the next row. As Kim does it takes which mode
        a row was in, given the next row's mode, from the rows up to here alone: exact only where no mode is drawn anew.
        """
        tiny = float(jnp.finfo(after.log_weights[0].dtype).tiny) ** 0.5
        later = [jnp.exp(w) for w in after.log_weights]
        components, log_weights = [], []
        for i, (chances, links) in enumerate(zip(rts_gain.chances, rts_gain.each, strict=True)):
            # A mode that nothing comes of goes on as itself, so that its weights add up to one too.
            joint = [p * w + (tiny if i == j else 0.0) for j, (p, w) in enumerate(zip(chances, later, strict=True))]
            probability = compute_once(total(joint))
            weights = [x / probability for x in joint]
            if len(links) == 1:
                found = self.filter.rts_step(links[0], merged(after.components, weights))
            else:
                found = merged(
                    [self.filter.rts_step(a, b) for a, b in zip(links, after.components, strict=True)], weights
                )
            components.append(compute_once(found))
            log_weights.append(jnp.where(rts_gain.joined, jnp.log(probability), rts_gain.filtered.log_weights[i]))
        return Mixture(tuple(components), tuple(log_weights))


def merged(components: Sequence[Gaussian], weights: Sequence[Scalar]) -> Gaussian:
    """The normal belief with the mean and covariance of a mixture whose weights add up to one."""
    origin = components[0].mean
    steps = [local(origin, g.mean) for g in components[1:]]
    middle = [total(w * s for w, s in zip(weights[1:], column, strict=True)) for column in zip(*steps, strict=True)]
    mean = retract(origin, middle) if middle else origin
    apart = [local(mean, g.mean) for g in components]
    cov = []
    for k, (i, j) in enumerate(triangle(len(apart[0]))):
        cov.append(total(w * (g.cov[k] + d[i] * d[j]) for w, g, d in zip(weights, components, apart, strict=True)))
    return Gaussian(mean, tuple(cov))


def _of(part: Any, mode: int) -> Any:
    return part.in_mode(mode) if isinstance(part, AbstractSwitching) else part
