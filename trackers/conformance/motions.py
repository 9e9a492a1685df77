"""The contract of a motion."""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.conformance.contract import BrokenContract, Check, NotApplicable, Report, report, require_part
from trackwright.trackers.conformance.differences import central_differences
from trackwright.trackers.conformance.traced import (
    arrays,
    attributes_named,
    called,
    described,
    known_inputs,
    require_finite,
    same_bits,
    shapes_of,
    unlike,
)
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, densify
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.state import State, component_names, coordinates, local, retract
from trackwright.trackers.core.model.tunable import AbstractTunable, freeze, replaced, tunables

DRAWS = 4096
"""Noise draws over which the derivative of a log density is averaged, and its limit in standard errors."""

STANDARD_ERRORS = 5.0


def check_motion(
    motion: AbstractMotion, state: State, inputs: Inputs | None = None, dt: float = 0.1, seed: int = 0
) -> Report:
    """What `motion_checks` find."""
    return report(motion_checks(motion, state, inputs, dt, seed))


def motion_checks(
    motion: AbstractMotion, state: State, inputs: Inputs | None = None, dt: float = 0.1, seed: int = 0
) -> list[Check]:
    """The checks of a motion at `state`, with the known `inputs` of one row, for steps of 0 s and of `dt` s.

    `step` returns a state of the same structure, which is the given one to the bit for dt = 0 whatever the noise, and
    has all its randomness in `w`; values and derivatives are finite; the covariance that a filter predicts is that of
    difference quotients of `step`, also where there are `stages`; a `log_density` is that of normal noise. Raises
    UnusableInput for an object of another kind.
    """
    require_part("check_motion", motion)
    name = type(motion).__name__
    q = motion.noise_dimension
    components = [*component_names(arrays(state)), *(f"w.{k}" for k in range(q))]
    # The first draw is zero, where filters linearise.
    noise = np.concatenate([np.zeros((1, q)), np.random.default_rng(seed).normal(size=(2, q))])
    single, here = freeze(arrays(motion)), arrays(state)
    point, rebuild = coordinates(here)

    @cache
    def given() -> Inputs:
        return known_inputs(f"{name}.step", motion.inputs, 0, here, inputs)

    def step(interval: Any, w: Any) -> State:
        with attributes_named(f"{name}.step", "state", here):
            return single.step(here, given(), interval, Vector.of(w))

    def jacobian_of(interval: Any, w: Any) -> Any:
        after = step(interval, w)

        def deviation(*values: Scalar) -> list[Scalar]:
            moved = rebuild(values[: len(point)])
            return local(after, single.step(moved, given(), interval, Vector.of(values[len(point) :])))

        return densify(linearise(deviation, [*point, *w])[1], len(components), jnp.zeros(()))

    jitted_step, jitted_jacobian = jax.jit(step), jax.jit(jacobian_of)

    def stepped(interval: float, draw: np.ndarray) -> State:
        given()  # before anything is traced
        return called(f"{name}.step", jitted_step, jnp.asarray(interval), list(arrays(draw)))

    def check_state() -> None:
        after = stepped(dt, noise[0])
        # jax's stubs give a tree structure no typed equality.
        same_tree = jax.tree_util.tree_structure(after) == jax.tree_util.tree_structure(here)  # type: ignore[operator]
        if not same_tree or shapes_of(after) != shapes_of(here):
            raise BrokenContract(
                f"{name}.step returns {unlike(after, here)}, expected a state like the given one: {described(here)}; "
                "usual fix: the same class, with a scalar for a scalar"
            )

    def check_zero_interval() -> None:
        for draw in noise:
            after = stepped(0.0, draw)
            shift = np.abs(np.array([float(x) for x in local(here, after)]))
            if not same_bits(after, here):
                raise BrokenContract(
                    f"{name}.step with dt = 0 changes {components[int(np.argmax(shift))]} by {shift.max():.3g}, "
                    "expected a bit-identical state whatever the noise; usual fix: a factor that is zero "
                    "for dt = 0 in each term"
                )

    def check_finite() -> None:
        for interval in (0.0, dt):
            for draw in noise:
                after = jnp.stack(coordinates(stepped(interval, draw))[0])
                require_finite(f"{name}.step at dt = {interval} s", after, components)
                jacobian = called(f"{name}.step", jitted_jacobian, jnp.asarray(interval), list(arrays(draw)))
                require_finite(f"the derivative of {name}.step at dt = {interval} s", jacobian, components)

    def check_randomness() -> None:
        again = jax.jit(lambda *x: step(*x))(jnp.asarray(dt), list(arrays(noise[-1])))
        if not same_bits(stepped(dt, noise[-1]), again):
            raise BrokenContract(
                f"{name}.step gives other numbers when traced again; expected all its randomness in w; usual fix: "
                "w[k] in place of a random number of its own"
            )

    def check_derivatives() -> str:
        with jax.enable_x64(True):
            predicted, expected = _predicted_covariances(freeze(arrays(motion)), arrays(state), inputs, dt, name)
        error = np.abs(predicted - expected)
        worst = np.unravel_index(int(np.argmax(error)), error.shape)
        if not error.max() <= 1e-5 * np.abs(expected).max():
            i, j = (components[k] for k in worst)
            raise BrokenContract(
                f"the covariance of {i} and {j} that a filter predicts by the derivatives of {name} is "
                f"{predicted[worst]:.6g}, by difference quotients of its step {expected[worst]:.6g}; usual fix: no "
                "stop_gradient or custom derivative in `step`, and `stages` that together are `step`"
            )
        return f"equal to difference quotients within {error.max() / np.abs(expected).max():.0e}"

    def check_log_density() -> str:
        if type(motion).log_density is AbstractMotion.log_density:
            raise NotApplicable("the motion has no log_density, which particle filters alone need for a fit")
        with jax.enable_x64(True):
            scores = _scores(arrays(motion), arrays(state), inputs, dt, seed, name)
        for tunable, score in scores.items():
            mean, error = score.mean(), score.std() / np.sqrt(len(score))
            if not abs(mean) <= STANDARD_ERRORS * error:
                raise BrokenContract(
                    f"the derivative of {name}.log_density by {tunable} has the mean {mean:.3g} ± {error:.1g} over "
                    "draws, expected zero, as of every density; usual fix: draw_log_density(w[k], scale) for each w[k] "
                    "with the scale that multiplies it"
                )
        return f"mean score zero by {', '.join(scores)}"

    begun = Check("state", check_state)
    random = Check("randomness", check_randomness, begun)
    finite = Check("finite", check_finite, random)
    return [
        begun,
        Check("zero interval", check_zero_interval, begun),
        finite,
        random,
        Check("derivatives", check_derivatives, finite),
        Check("log density", check_log_density, begun),
    ]


def _predicted_covariances(
    motion: AbstractMotion, state: State, inputs: Inputs | None, dt: float, name: str
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """The covariance `dt` s later as the extended Kalman filter predicts it, and by central differences of `step`."""
    known, interval = known_inputs(f"{name}.step", motion.inputs, 0, state, inputs), jnp.asarray(dt)
    n, q = len(component_names(state)), motion.noise_dimension
    factor = 0.1 * np.random.default_rng(0).normal(size=(n, n)) + 0.3 * np.eye(n)
    P = factor @ factor.T
    belief = Gaussian(state, tuple(jnp.asarray(x) for x in P[np.triu_indices(n)]))
    held = motion.at(belief)
    after = held.step(state, known, interval, Vector.of(jnp.zeros(q)))

    @jax.jit
    @jax.vmap
    def moved(change: Float[Array, " all"]) -> Float[Array, " n"]:
        before = retract(state, list(change[:n]))
        return jnp.stack(local(after, held.step(before, known, interval, Vector.of(change[n:]))))

    jacobian = central_differences(f"{name}.step", moved, n + q)
    F, G = jacobian[:, :n], jacobian[:, n:]
    predicted = jax.jit(lambda b: matrix(ExtendedKalman().predict(b, motion, known, interval).cov))(belief)
    return np.asarray(predicted), F @ P @ F.T + G @ G.T


def _scores(
    motion: AbstractMotion, state: State, inputs: Inputs | None, dt: float, seed: int, name: str
) -> dict[str, Float[np.ndarray, " draws"]]:
    """The derivatives of the log density by each tunable that it depends on, at draws of unit white noise."""
    known = known_inputs(f"{name}.step", motion.inputs, 0, state, inputs)
    nodes = tunables(motion)
    draws = np.random.default_rng(seed).normal(size=(DRAWS, motion.noise_dimension))

    @jax.jit
    @jax.vmap
    def slopes(w: Float[Array, " q"]) -> dict[str, AbstractTunable]:
        def density(nodes: dict[str, AbstractTunable]) -> Scalar:
            changed = freeze(replaced(motion, nodes))
            return changed.log_density(state, known, jnp.asarray(dt), Vector.of(w))

        return jax.grad(density)(nodes)

    each = {key: np.asarray(node.raw).reshape(DRAWS, -1).sum(axis=1) for key, node in slopes(draws).items()}
    return {key: score for key, score in each.items() if score.any()}
