"""The contracts of a motion and of a sensor, each at one state, as functions that assert."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from trackwright.trackers.conformance.contract import (
    BrokenContract,
    Check,
    NotApplicable,
    check,
    reported,
    require_part,
)
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, densify
from trackwright.trackers.core.model.covariance import Gaussian, matrix
from trackwright.trackers.core.model.inputs import Inputs, Need
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion, ConstantPosition
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Residual
from trackwright.trackers.core.model.state import State, component_names, coordinates, local, retract
from trackwright.trackers.core.model.tunable import freeze, replaced, tunables
from trackwright.trackers.core.run.requirements import GivenInputs, MissingInputError

FAR = 1e6
"""Error of an outlier in units of a channel; the square of its whitened residual is still finite in float32."""

DRAWS = 4096
"""Noise draws over which the derivative of a log density is averaged, and numbers of a grid of readings."""


def motion_checks(
    motion: AbstractMotion, state: State, inputs: Inputs | None = None, dt: float = 0.1, seed: int = 0
) -> list[Check]:
    """The checks of a motion at `state`, with the known `inputs` of one row, for steps of 0 s and of `dt` s.

    `step` returns a state of the same structure, for dt = 0 the same bits whatever the noise, and has all its
    randomness in `w`; values and derivatives are finite; the covariance that a filter predicts is that of difference
    quotients, also where there are `stages`; a `log_density` is that of normal noise. Raises UnusableInput for an
    object of another kind.
    """
    require_part("check_motion", motion)
    what, q, rng = f"{type(motion).__name__}.step", motion.noise_dimension, np.random.default_rng(seed)
    draws = np.concatenate([np.zeros((1, q)), rng.normal(size=(2, q))])  # filters linearise at zero
    single, here = freeze(_arrays(motion)), _arrays(state)
    point, rebuild = coordinates(here)
    names, n = [*component_names(here), *(f"w.{k}" for k in range(q))], len(point)
    given = cache(lambda: _known(what, motion, 0, here, inputs))

    def step(interval: Any, w: Any) -> State:
        return single.step(here, given(), interval, Vector.of(w))

    def slopes(interval: Any, w: Any) -> Any:
        after = step(interval, w)

        def moved(*x: Scalar) -> list[Scalar]:
            return local(after, single.step(rebuild(x[:n]), given(), interval, Vector.of(x[n:])))

        return densify(linearise(moved, [*point, *w])[1], n + q, jnp.zeros(()))

    jitted, jitted_slopes = jax.jit(step), jax.jit(slopes)

    def stepped(interval: float, w: Any, function: Any = jitted) -> Any:
        given()  # before anything is traced
        with _told(what, "state", here):
            return function(jnp.asarray(interval), list(_arrays(w)))

    def same_bits(a: Any, b: Any) -> bool:
        return all(map(np.array_equal, jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b)))

    @check()
    def state_() -> None:
        after = stepped(dt, draws[0])
        found, expected = (repr(jax.tree_util.tree_map(jnp.shape, x)) for x in (after, here))
        twice = ", of another class of that name, whose file was run twice" * (found == expected)
        same = found == expected and type(after) is type(here)
        assert same, f"{what} returns {found}{twice}, expected a state like the given one: {expected}"

    @check(state_)
    def zero_interval() -> None:
        for after in [stepped(0.0, w) for w in draws]:
            shift = np.abs(np.array([float(x) for x in local(here, after)]))
            assert same_bits(after, here), (
                f"{what} with dt = 0 changes {names[int(np.argmax(shift))]} by {shift.max():.3g}, expected the same "
                "bits whatever the noise; usual fix: a factor that is zero for dt = 0 in each term"
            )

    @check(state_)
    def randomness() -> None:
        same = same_bits(stepped(dt, draws[-1]), stepped(dt, draws[-1], jax.jit(lambda *x: step(*x))))
        assert same, f"{what} gives other numbers when traced again, expected all its randomness in w"

    @check(randomness)
    def finite() -> None:
        for interval, w in [(interval, w) for interval in (0.0, dt) for w in draws]:
            place = f"{what} at dt = {interval} s"
            _finite(place, coordinates(stepped(interval, w))[0], names)
            _finite(f"the derivative of {place}", stepped(interval, w, jitted_slopes), names)

    @check(finite)
    @jax.enable_x64(True)
    def derivatives() -> str:
        single, here, interval = freeze(_arrays(motion)), _arrays(state), jnp.asarray(dt)
        known, factor = _known(what, motion, 0, here, inputs), np.random.default_rng(0).normal(size=(n, n))
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
        assert error.max() <= 1e-5 * size, (
            f"the covariance of {' and '.join(names[k] for k in worst)} that a filter predicts by the derivatives of "
            f"{what} is {found[worst]:.6g}, by difference quotients {expected[worst]:.6g}; usual fix: no "
            "stop_gradient or custom derivative, and `stages` that together are `step`"
        )
        return f"equal to difference quotients within {error.max() / size:.0e}"

    @check(state_)
    @jax.enable_x64(True)
    def log_density() -> str:
        if type(motion).log_density is AbstractMotion.log_density:
            raise NotApplicable("the motion has no log_density, which particle filters alone need for a fit")
        part, here = _arrays(motion), _arrays(state)
        known = _known(what, motion, 0, here, inputs)

        def density(nodes: Any, w: Any) -> Scalar:
            return freeze(replaced(part, nodes)).log_density(here, known, jnp.asarray(dt), Vector.of(w))

        scores = jax.jit(jax.vmap(jax.grad(density), (None, 0)))(tunables(part), rng.normal(size=(DRAWS, q)))
        for name, node in scores.items():
            score = np.asarray(node.raw).reshape(DRAWS, -1).sum(axis=1)
            mean, error = score.mean(), score.std() / np.sqrt(DRAWS)
            assert abs(mean) <= 5 * error, (
                f"the derivative of log_density by {name} has the mean {mean:.3g} ± {error:.1g} over draws, expected "
                "zero; usual fix: draw_log_density(w[k], scale) with the scale that multiplies each w[k]"
            )
        return f"mean score zero by {', '.join(scores)}"

    return [state_, zero_interval, randomness, finite, derivatives, log_density]


def sensor_checks(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None = None, reported: Sequence[float] = (), seed: int = 0
) -> list[Check]:
    """The checks of a sensor at `view`, a `motion.view` of a state, with the known `inputs` of one row.

    One predicted and one whitened number per channel; a masked channel has no influence and adds nothing to `nis_dof`;
    residuals and derivatives are finite for outliers, and derivatives are difference quotients; the density integrates
    to 1 over readings, for up to three channels at a time, the others masked. `reported`: the noise columns of one
    reading. The integral over an angle needs noise well below half a turn. Raises UnusableInput for an object of
    another kind.
    """
    require_part("check_sensor", sensor)
    at, m, everything = _At(sensor, view, inputs, reported), len(sensor.channels), np.ones(len(sensor.channels), bool)
    what, names = f"{type(sensor).__name__}.residual", [channel.name for channel in sensor.channels]

    @check()
    def measure() -> None:
        at.predicted()

    @check(measure)
    def residual() -> None:
        whitened, _, dof = at.residual(0.0, everything)
        zero = np.abs(whitened).max() <= 1e-3
        assert zero, f"{what} of a reading equal to the prediction is {whitened}, expected zeros: reading − prediction"
        assert 0 < dof <= m, (
            f"{what} counts {dof:g} numbers with all channels seen, expected between 1 and {m}; usual fix: nis_dof is "
            "the number of channels seen, less what they have in common"
        )

    @check(residual)
    def mask() -> None:
        rng = np.random.default_rng(seed)
        for seen in (~everything, *~np.eye(m, dtype=bool), *(rng.random((4, m)) < 0.5)):
            offset = 0.1 * rng.normal(size=m)
            whitened, scale, dof = at.residual(offset, seen)
            other = at.residual(np.where(seen, offset, offset + 3.0), seen)
            place = f"seen: {seen}; usual fix: jnp.where(seen, …, 0.0), as `independent` does"
            assert not whitened[~seen].any(), f"{what} is {whitened}, expected 0 for a masked channel, {place}"
            assert dof <= seen.sum(), f"{what} counts {dof:g} numbers where {seen.sum()} channels were seen, {place}"
            empty = f"nis_dof {dof:g} and log_scale {scale:.4g}, expected 0 and 0"
            assert seen.any() or (dof, scale) == (0, 0), f"{what} with no channel seen has {empty}, {place}"
            same = np.array_equal([*whitened, scale, dof], [*other[0], *other[1:]])
            assert same, f"{what} changes with the value of a masked channel, expected no change, {place}"

    @check(residual)
    def finite() -> None:
        for offset, seen in [(offset, seen) for offset in (0.0, FAR, -FAR) for seen in (everything, ~everything)]:
            place = f"{what} of a reading off by {offset:g}"
            _finite(place, at.residual(offset, seen)[0], names)
            _finite(f"the derivative of {place}", at.slopes(_arrays(at.predicted() + offset), seen), names)

    @check(finite)
    @jax.enable_x64(True)
    def derivatives() -> str:
        double = _At(sensor, view, inputs, reported)
        values, n = _arrays(double.predicted() + 0.01 * np.cos(np.arange(m))), len(double.point)

        def moved(x: Any) -> jax.Array:
            return jnp.stack(double.whitened(retract(double.view, list(x)), values, everything).whitened)

        numeric = _differences(what, moved, n)
        # Away from this view, too, where a derivative may vanish: a speed at rest.
        moves = numeric.any() or _differences(what, lambda x: moved(x + np.cos(np.arange(n))), n).any()
        assert moves, (
            f"the derivative of {at.what} by every component of the view is zero: no reading changes an estimate"
        )
        exact = np.asarray(double.slopes(values, everything))
        error, size = np.abs(exact - numeric), max(np.abs(numeric).max(), 1e-9)
        k, j = np.unravel_index(int(np.argmax(error)), error.shape)
        assert error.max() <= 1e-4 * size, (
            f"the derivative of the whitened {names[k]} by {component_names(view)[j]} is {exact[k, j]:.6g}, by "
            f"difference quotients {numeric[k, j]:.6g}; usual fix: no stop_gradient, rounding or custom derivative"
        )
        return f"equal to difference quotients within {error.max() / size:.0e}"

    @check(mask)
    def density() -> str:
        worst, unread = 0.0, ~np.any(at.by_reading(_arrays(at.predicted()), everything), axis=0)
        for size, first in [(k, j) for k in (1, 2, 3) for j in range(m - k + 1)]:
            seen = (np.arange(m) >= first) & (np.arange(m) < first + size)
            # Channels with a part in common have a density of what is left.
            free = np.flatnonzero(seen)[round(size - at.residual(0.0, seen)[2]) :]
            if len(free) and not (seen & unread).any():
                mass, wrapped = at.mass(seen, free)
                assert abs(mass - 1) < 2e-3 + wrapped, (
                    f"the density of {type(sensor).__name__} integrates to {mass:.4g} over "
                    f"{', '.join(names[j] for j in free)}, expected 1; usual fix: log_scale is −½ log 2π − log sigma "
                    "for each channel seen, of the sigma that whitens"
                )
                worst = max(worst, abs(mass - 1))
        return f"integrates to 1 within {worst:.0e}"

    return [measure, residual, mask, finite, derivatives, density]


check_motion, check_sensor = reported(motion_checks), reported(sensor_checks)


class _At:
    """A sensor at a view in jax's default precision: predictions, residuals, their derivatives and density."""

    def __init__(self, sensor: AbstractSensor, view: Any, inputs: Any, reported: Sequence[float]) -> None:
        self.single, self.view, self.noise = freeze(_arrays(sensor)), _arrays(view), jnp.asarray(reported, float)
        self.what, self.names = f"{type(sensor).__name__}.measure", [channel.name for channel in sensor.channels]
        self.point, self.rebuild = coordinates(self.view)
        self.known = cache(lambda: _known(self.what, sensor, len(self.names), self.view, inputs))
        self.predicted, self.slopes = cache(self._predicted), jax.jit(self._slopes)
        self.jitted = jax.jit(lambda values, seen: self.whitened(self.view, values, seen))
        self.by_reading = jax.jit(jax.jacfwd(lambda z, seen: jnp.stack(self.jitted(z, seen).whitened)))
        self.densities = jax.jit(jax.vmap(self._density, (0, None)))

    def _predicted(self) -> np.ndarray:
        known = self.known()
        for field in self.single.view_fields:
            expected = f"expected a view with it, found {type(self.view).__name__}"
            assert hasattr(self.view, field), f"{self.what} reads '{field}' of the view; {expected}"
        with _told(self.what, "view", self.view):
            values = jax.jit(lambda: list(self.single.measure(self.view, known)))()
        shapes, expected = [jnp.shape(z) for z in values], f"{len(self.names)} scalars: {', '.join(self.names)}"
        assert shapes == [()] * len(self.names), f"{self.what} returns numbers of shapes {shapes}, expected {expected}"
        _finite(self.what, values, self.names)
        return np.array([float(z) for z in values])

    def whitened(self, view: Any, values: Any, seen: Any) -> Residual:
        predicted = list(self.single.measure(view, self.known()))
        result = self.single.residual(Reading(values, seen, self.noise), predicted)
        return result._replace(whitened=list(result.whitened))

    def _slopes(self, values: Any, seen: Any) -> Any:
        rows = linearise(lambda *x: list(self.whitened(self.rebuild(x), values, seen).whitened), self.point)[1]
        return densify(rows, len(self.point), jnp.zeros(()))

    def residual(self, offset: Any, seen: Any) -> tuple[np.ndarray, float, float]:
        """The whitened residual of a reading off the prediction, log_scale and nis_dof."""
        with _told(self.what, "view", self.view):
            result = self.jitted(_arrays(self.predicted() + offset), np.asarray(seen, bool))
        found, m = len(result.whitened), len(self.names)
        assert found == m, f"the residual has {found} whitened numbers, expected one per channel, {m}"
        return np.array([float(r) for r in result.whitened]), float(result.log_scale), float(result.nis_dof)

    def mass(self, seen: np.ndarray, free: np.ndarray) -> tuple[float, float]:
        """∫ density over the free channels, the others at the prediction, and the probability lost by wrapping.

        Trapezoidal rule in s with u = sinh s the whitened reading: exponentially accurate for the normal density, and
        far into the tails of Student's t.
        """
        k, here = len(free), _arrays(self.predicted())
        slopes, dof = np.array(self.by_reading(here, seen), float)[:, free], self.jitted(here, seen).dof
        dof = math.inf if dof is None else float(dof)
        rows = slopes[np.any(slopes != 0, axis=1)]
        factor = rows if len(rows) == k else np.linalg.qr(slopes)[1]
        if not np.all(np.isfinite(factor)) or abs(np.linalg.det(factor)) < 1e-30:
            return math.nan, 0.0
        inverse, reach = np.linalg.inv(factor), math.asinh(8.0) if dof == math.inf else min(3.0 + 16.0 / dof, 18.0)
        s = np.linspace(-reach, reach, {1: DRAWS, 2: 64, 3: 32}[k])
        grid = np.stack(np.meshgrid(*[s] * k, indexing="ij"), axis=-1).reshape(-1, k)
        offsets, values = np.sinh(grid) @ inverse.T, np.tile(self.predicted(), (len(grid), 1))
        values[:, free] += offsets
        blocks = [self.densities(_arrays(block), seen) for block in np.split(values, len(grid) // DRAWS)]
        weight = np.prod(np.cosh(grid), axis=1) * (s[1] - s[0]) ** k * abs(np.linalg.det(inverse))
        wraps = np.array([self.single.channels[j].wraps for j in free])
        weight *= np.all((np.abs(offsets) <= np.pi) | ~wraps, axis=1)
        sigmas = np.sqrt(np.sum(inverse**2, axis=1))[wraps]
        beyond = float(np.sum(2 * scipy.stats.t.sf(np.pi / sigmas, dof)))
        return float(np.exp(np.concatenate(blocks).astype(float)) @ weight), beyond

    def _density(self, values: Any, seen: Any) -> Any:
        """The log-likelihood of a reading by the update of a state that is known exactly."""
        belief = Gaussian(self.view, (jnp.zeros(()),) * (len(self.point) * (len(self.point) + 1) // 2))
        still, reading = ConstantPosition(1.0, 2), Reading(values, seen, self.noise)
        return ExtendedKalman().update(belief, still, self.single, reading, self.known())[1].log_likelihood


def _arrays(tree: Any) -> Any:
    """The tree with its floats as arrays of jax's default precision, as in a run."""
    kind = jnp.zeros(0).dtype

    def cast(x: Any) -> Any:
        floats = isinstance(x, float) or np.issubdtype(getattr(x, "dtype", int), np.floating)
        return jnp.asarray(x, kind) if floats else jnp.asarray(x) if hasattr(x, "dtype") else x

    return jax.tree_util.tree_map(cast, tree)


@contextmanager
def _told(what: str, role: str, given: Any) -> Iterator[None]:
    """What goes wrong in a user's function of `given`, the view or the state, as a sentence."""
    try:
        yield
    except AttributeError as error:
        fields = ", ".join(dict.fromkeys(name.partition(".")[0] for name in component_names(given)))
        has = f"the {role}, a {type(given).__name__}, which has {fields}"
        if isinstance(error.obj, Vector):
            has = f"a vector; expected its components by number, [0] to [{len(error.obj) - 1}]"
        elif error.obj is not given:
            raise
        raise BrokenContract(f"{what} reads '{error.name}' of {has}") from None
    except MissingInputError as missing:
        found = f"{missing.reader} reads the input '{missing.name}', which is neither declared nor given"
        raise BrokenContract(f"{found}; expected it in `inputs`, the property and the argument of this check") from None
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        found = f"{what} cannot be traced ({str(error).splitlines()[0]})"
        raise BrokenContract(f"{found}; usual fix: jnp.where instead of if, jnp instead of math and numpy") from error


def _known(what: str, part: Any, channels: int, view: Any, inputs: Inputs | None) -> GivenInputs:
    """The inputs as arrays, those that the part declares in its shapes."""
    there, planar = GivenInputs(_arrays(dict(inputs or {})), what), len(getattr(view, "position", ())) == 2
    for one in part.inputs:
        name, shape = one.name, one.row_shape(channels)
        needed = one.need is Need.ALWAYS or (one.need is Need.PLANAR and planar)
        found = f"shape {np.shape(there[name])}" if name in there else ", ".join(there) or "no input"
        assert np.shape(there[name]) == shape if name in there else not needed, (
            f"{what} reads the input '{name}', found {found}; expected {name}, shape {shape}, {one.unit or '1'}: "
            f"{one.about}; usual fix: inputs={{'{name}': …}} of one row in the call of this check"
        )
    return there


def _finite(what: str, values: Any, names: Sequence[str]) -> None:
    """Asserts that values are finite: one row, or one number, per name."""
    bad = [name for name, row in zip(names, values, strict=False) if not np.isfinite(np.asarray(row)).all()]
    fix = "usual fix: jnp.where around the argument of a root, division or arctangent"
    assert not bad, f"{what} is not finite at {bad[0]}; {fix}"


def _differences(what: str, function: Callable[[Any], jax.Array], n: int) -> np.ndarray:
    """The Jacobian at zero of a function (n,) → (m,); raises NotApplicable where it has a corner."""
    half = 1e-5
    shifts = half * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    here, above, below = np.split(np.asarray(jax.jit(jax.vmap(function))(shifts), float), [1, n + 1])
    slopes = (above - below).T / (2 * half)
    if np.abs(above + below - 2 * here).max() / half > 1e-3 * np.abs(slopes).max():
        raise NotApplicable(f"{what} has a corner here, where it has no derivative; check it at another state")
    return slopes
