"""Contracts as lists of functions that assert; those of a motion and of a sensor, each at one state."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any, ParamSpec
from unittest import SkipTest

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.errors import one_line, require
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, densify
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Residual
from trackwright.trackers.core.model.state import State, component_names, coordinates, local, retract
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.requirements import GivenInputs

P = ParamSpec("P")


class BrokenContract(AssertionError):  # noqa: N818 - public name
    """A part of a user violates an assumption of the library: found, expected, usual fix in one sentence."""


class NotApplicable(SkipTest):
    """The reason why a check has nothing to say of a part."""


@dataclass(frozen=True, eq=False)
class Check:
    """A function that asserts; called, it raises BrokenContract, or NotApplicable, which pytest takes for a skip."""

    test: Callable[[], None]

    def __str__(self) -> str:
        return self.test.__name__.strip("_").replace("_", " ")

    def __call__(self) -> None:
        if not __debug__:
            raise NotApplicable("needs python without -O, which leaves asserts out")
        try:
            self.test()
        except NotApplicable:
            raise
        except Exception as error:
            kind = "" if isinstance(error, AssertionError) else f"{type(error).__name__}: "
            raise BrokenContract(f"{self}: {kind}{one_line(error)}") from error


def asserted(checks: Callable[P, list[Check]]) -> Callable[P, None]:
    """A function of the same arguments that runs all checks that apply, and raises what the first broken one found."""

    @wraps(checks)
    def run(*given: P.args, **named: P.kwargs) -> None:
        for check in checks(*given, **named):
            with suppress(NotApplicable):
                check()

    return run


FAR = 1e6  # an outlier, in units of a channel, the square of whose whitened residual is finite in float32


def motion_checks(motion: AbstractMotion, state: State, inputs: Inputs | None = None, dt: float = 0.1) -> list[Check]:
    """The checks of a motion at `state`, with the known `inputs` of one row, for steps of 0 s and of `dt` s.

    `step` returns a state of the same structure, for dt = 0 the same bits whatever the noise, and has all its
    randomness in `w`; values are finite; a filter predicts the covariance of difference quotients, also by `stages`.
    """
    require(isinstance(motion, AbstractMotion), "check_motion", motion, "an object of AbstractMotion")
    what, q, rng = f"{type(motion).__name__}.step", motion.noise_dimension, np.random.default_rng(0)
    draws = np.concatenate([np.zeros((1, q)), rng.normal(size=(2, q))])  # filters linearise at zero
    single, here = freeze(_arrays(motion)), _arrays(state)
    point, rebuild = coordinates(here)
    names, n = [*component_names(here), *(f"w.{k}" for k in range(q))], len(point)
    given = GivenInputs(_arrays(dict(inputs or {})), what)

    def step(interval: Any, w: Any) -> State:
        return single.step(here, given, interval, Vector.of(w))

    def slopes(interval: Any, w: Any) -> Any:
        after = step(interval, w)

        def moved(*x: Scalar) -> list[Scalar]:
            return local(after, single.step(rebuild(x[:n]), given, interval, Vector.of(x[n:])))

        return densify(linearise(moved, [*point, *w])[1], n + q, jnp.zeros(()))

    jitted, jitted_slopes = jax.jit(step), jax.jit(slopes)

    def stepped(interval: float, w: Any, function: Any = jitted) -> Any:
        return function(jnp.asarray(interval), list(_arrays(w)))

    def same_bits(a: Any, b: Any) -> bool:
        return all(map(np.array_equal, jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b)))

    @Check
    def state_() -> None:
        after = stepped(dt, draws[0])
        found, expected = (repr(jax.tree_util.tree_map(jnp.shape, x)) for x in (after, here))
        assert found == expected, f"{what} returns {found}, expected a state like the given one: {expected}"

    @Check
    def zero_interval() -> None:
        for after in [stepped(0.0, w) for w in draws]:
            assert same_bits(after, here), f"{what} with dt = 0 changes the state; usual fix: a factor dt in each term"

    @Check
    def randomness() -> None:
        same = same_bits(stepped(dt, draws[-1]), stepped(dt, draws[-1], jax.jit(lambda *x: step(*x))))
        assert same, f"{what} gives other numbers when traced again, expected all its randomness in w"

    @Check
    def finite() -> None:
        for interval, w in itertools.product((0.0, dt), draws):
            place = f"{what} at dt = {interval} s"
            _finite(place, coordinates(stepped(interval, w))[0], names)
            _finite(f"the derivative of {place}", stepped(interval, w, jitted_slopes), names)

    @Check
    @jax.enable_x64(True)
    def derivatives() -> None:
        single, here, interval = freeze(_arrays(motion)), _arrays(state), jnp.asarray(dt)
        known, factor = GivenInputs(_arrays(dict(inputs or {})), what), np.random.default_rng(0).normal(size=(n, n))
        P = (0.1 * factor + 0.3 * np.eye(n)) @ (0.1 * factor + 0.3 * np.eye(n)).T
        belief = Gaussian(here, tuple(jnp.asarray(x) for x in P[np.triu_indices(n)]))
        held = single.at(belief)
        after = held.step(here, known, interval, Vector.of(jnp.zeros(q)))

        def moved(x: Any) -> jax.Array:
            return jnp.stack(local(after, held.step(retract(here, list(x[:n])), known, interval, Vector.of(x[n:]))))

        F, G = np.split(_differences(what, moved, n + q), [n], axis=1)
        expected = F @ P @ F.T + G @ G.T
        found = np.asarray(jax.jit(lambda b: matrix(ExtendedKalman().predict(b, single, known, interval).cov))(belief))
        error, size = np.abs(found - expected), np.abs(expected).max()
        worst = np.unravel_index(int(np.argmax(error)), error.shape)
        words = f"covariance of {' and '.join(names[k] for k in worst)} is {found[worst]:.6g}, by difference quotients"
        fix = f"{expected[worst]:.6g}; usual fix: no stop_gradient, `stages` that together are `step`"
        assert error.max() <= 1e-5 * size, f"the predicted {words} {fix}"

    return [state_, zero_interval, randomness, finite, derivatives]


def sensor_checks(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None = None, reported: Sequence[float] = ()
) -> list[Check]:
    """The checks of a sensor at `view`, a `motion.view` of a state, with the known `inputs` of one row.

    One predicted and one whitened number per channel; a masked channel has no influence; residuals are finite for
    outliers, derivatives are difference quotients; `log_scale` makes a density of the residual. `reported`: the noise
    columns of one reading.
    """
    require(isinstance(sensor, AbstractSensor), "check_sensor", sensor, "an object of AbstractSensor")
    at, m, everything = _At(sensor, view, inputs, reported), len(sensor.channels), np.ones(len(sensor.channels), bool)
    what, names = f"{type(sensor).__name__}.residual", [channel.name for channel in sensor.channels]

    @Check
    def measure() -> None:
        at.predicted()

    @Check
    def residual() -> None:
        whitened, _, dof = at.residual(0.0, everything)
        assert np.abs(whitened).max() <= 1e-3, f"{what} of a reading equal to the prediction is {whitened}, not zero"
        assert 0 < dof <= m, f"{what} has nis_dof {dof:g}, expected at most the channels seen, {m}"

    @Check
    def mask() -> None:
        rng = np.random.default_rng(0)
        for seen in (~everything, *~np.eye(m, dtype=bool), *(rng.random((4, m)) < 0.5)):
            offset = 0.1 * rng.normal(size=m)
            whitened, scale, dof = at.residual(offset, seen)
            other = at.residual(np.where(seen, offset, offset + 3.0), seen)
            same = np.array_equal([*whitened, scale, dof], [*other[0], *other[1:]])
            kept = same and not whitened[~seen].any() and dof <= seen.sum() and (seen.any() or scale == 0)
            found = f"whitened {whitened}, nis_dof {dof:g}, log_scale {scale:.4g} of seen {seen}"
            assert kept, f"{what} reads a masked channel: {found}; usual fix: jnp.where(seen, …, 0.0)"

    @Check
    def finite() -> None:
        for offset, seen in itertools.product((0.0, FAR, -FAR), (everything, ~everything)):
            place = f"{what} of a reading off by {offset:g}"
            _finite(place, at.residual(offset, seen)[0], names)
            _finite(f"the derivative of {place}", at.slopes(_arrays(at.predicted() + offset), seen), names)

    @Check
    @jax.enable_x64(True)
    def derivatives() -> None:
        double = _At(sensor, view, inputs, reported)
        values, n = _arrays(double.predicted() + 0.01 * np.cos(np.arange(m))), len(double.point)

        def moved(x: Any) -> jax.Array:
            return jnp.stack(double.whitened(retract(double.view, list(x)), values, everything).whitened)

        numeric = _differences(what, moved, n)
        # Away from this view, too, where a derivative may vanish: a speed at rest.
        moves = numeric.any() or _differences(what, lambda x: moved(x + np.cos(np.arange(n))), n).any()
        assert moves, f"the derivative of {at.what} by every component of the view is zero"
        exact = np.asarray(double.slopes(values, everything))
        error, size = np.abs(exact - numeric), max(np.abs(numeric).max(), 1e-9)
        k, j = np.unravel_index(int(np.argmax(error)), error.shape)
        found = f"the derivative of whitened {names[k]} by {component_names(view)[j]} is {exact[k, j]:.6g}"
        fix = f"by difference quotients {numeric[k, j]:.6g}; usual fix: no stop_gradient"
        assert error.max() <= 1e-4 * size, f"{found}, {fix}"

    @Check
    def density() -> None:
        s = np.linspace(-8.0, 8.0, 4096)  # trapezoidal rule in s, far into the tails of Student's t
        for j, seen in enumerate(np.eye(m, dtype=bool)):
            slope = float(at.by_reading(_arrays(at.predicted()), seen)[:, j].sum())
            values = np.tile(at.predicted(), (len(s), 1))
            if at.residual(0.0, seen)[2] == 0 or slope == 0:
                continue  # of several channels with a part in common, one alone says nothing
            values[:, j] += (offsets := np.sinh(s) / abs(slope))
            weight = np.cosh(s) * (np.abs(offsets) <= (np.pi if sensor.channels[j].wraps else np.inf))
            mass = np.exp(np.asarray(at.densities(_arrays(values), seen), float)) @ weight * (s[1] - s[0]) / abs(slope)
            fix = "usual fix: log_scale is −½ log 2π − log sigma for each channel seen"
            assert abs(mass - 1) < 5e-3, f"the density of {names[j]} integrates to {mass:.4g}, expected 1; {fix}"

    return [measure, residual, mask, finite, derivatives, density]


check_motion = asserted(motion_checks)
check_sensor = asserted(sensor_checks)


class _At:
    """A sensor at a view in jax's default precision: predictions, residuals and their derivatives."""

    def __init__(self, sensor: AbstractSensor, view: Any, inputs: Any, reported: Sequence[float]) -> None:
        self.single, self.view, self.noise = freeze(_arrays(sensor)), _arrays(view), jnp.asarray(reported, float)
        self.what, self.names = f"{type(sensor).__name__}.measure", [channel.name for channel in sensor.channels]
        self.point, self.rebuild = coordinates(self.view)
        self.known = GivenInputs(_arrays(dict(inputs or {})), self.what)
        self.predicted, self.slopes = cache(self._predicted), jax.jit(self._slopes)
        self.jitted = jax.jit(lambda values, seen: self.whitened(self.view, values, seen))
        self.densities = jax.jit(jax.vmap(lambda z, seen: self.jitted(z, seen).log_density, (0, None)))
        self.by_reading = jax.jit(jax.jacfwd(lambda z, seen: jnp.stack(self.jitted(z, seen).whitened)))

    def _predicted(self) -> np.ndarray:
        values = jax.jit(lambda: list(self.single.measure(self.view, self.known)))()
        shapes = [jnp.shape(z) for z in values]
        assert shapes == [()] * len(self.names), f"{self.what} returns shapes {shapes}, expected scalars: {self.names}"
        _finite(self.what, values, self.names)
        return np.array([float(z) for z in values])

    def whitened(self, view: Any, values: Any, seen: Any) -> Residual:
        predicted = list(self.single.measure(view, self.known))
        result = self.single.residual(Reading(values, seen, self.noise), predicted)
        return result._replace(whitened=list(result.whitened))

    def _slopes(self, values: Any, seen: Any) -> Any:
        rows = linearise(lambda *x: list(self.whitened(self.rebuild(x), values, seen).whitened), self.point)[1]
        return densify(rows, len(self.point), jnp.zeros(()))

    def residual(self, offset: Any, seen: Any) -> tuple[np.ndarray, float, float]:
        """The whitened residual of a reading off the prediction, log_scale and nis_dof."""
        result = self.jitted(_arrays(self.predicted() + offset), np.asarray(seen, bool))
        found, m = len(result.whitened), len(self.names)
        assert found == m, f"the residual has {found} whitened numbers, expected one per channel, {m}"
        return np.array([float(r) for r in result.whitened]), float(result.log_scale), float(result.nis_dof)


def _arrays(tree: Any) -> Any:
    """The tree with its floats as arrays of jax's default precision, as in a run."""
    return as_dtype(tree, jnp.zeros(0).dtype)


def _finite(what: str, values: Any, names: Sequence[str]) -> None:
    """Asserts that values are finite: one row, or one number, per name."""
    bad = [name for name, row in zip(names, values, strict=False) if not np.isfinite(np.asarray(row)).all()]
    assert not bad, f"{what} is not finite at {bad[0]}; usual fix: jnp.where around the argument of a root or division"


def _differences(what: str, function: Callable[[Any], jax.Array], n: int) -> np.ndarray:
    """The Jacobian at zero of a function (n,) → (m,); raises NotApplicable where it has a corner."""
    half = 1e-5
    shifts = half * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    here, above, below = np.split(np.asarray(jax.jit(jax.vmap(function))(shifts), float), [1, n + 1])
    slopes = (above - below).T / (2 * half)
    if np.abs(above + below - 2 * here).max() / half > 1e-3 * np.abs(slopes).max():
        raise NotApplicable(f"{what} has a corner here; check it at another state")
    return slopes
