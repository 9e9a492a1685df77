"""Contract checks for user-defined motions and sensors, to run before they are used in a filter.

They take seconds and belong in a test. A violation raises `BrokenContract` with one line: found, expected, usual fix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, densify
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Input, Inputs, Need
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Residual
from trackwright.trackers.core.model.state import State, component_names, coordinates, local
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.requirements import GivenInputs, MissingInputError

Tree = TypeVar("Tree")

FAR = 1e6
"""Error of an outlier in units of a channel; the square of its whitened residual is still finite in float32."""


class BrokenContract(ValueError):  # noqa: N818 - public name
    """A motion or a sensor violates an assumption of the filters."""


class Still(AbstractMotion):
    """A motion that leaves the state unchanged."""

    @property
    def noise_dimension(self) -> int:
        return 0

    def step(self, state: State, inputs: Inputs, dt: Scalar, w: Vector) -> State:
        return state


def check_motion(
    motion: AbstractMotion, state: State, inputs: Inputs | None = None, dt: float = 0.1, seed: int = 0
) -> None:
    """Raises `BrokenContract` unless `motion` fulfils its contract at `state`, for dt = 0 and for `dt` s.

    Contract: `step` returns a state of the same structure, equals the state for dt = 0 whatever the noise, is
    deterministic, and has finite values and derivatives with respect to state and noise.
    """
    name = type(motion).__name__
    motion, state = freeze(_arrays(motion)), _arrays(state)
    inputs = _given(f"{name}.step", motion.inputs, 0, state, inputs)
    point, rebuild = coordinates(state)
    components = [*component_names(state), *(f"w.{k}" for k in range(motion.noise_dimension))]
    noise = np.random.default_rng(seed).normal(size=(3, motion.noise_dimension))

    def step(interval: Any, w: Any) -> State:
        with _attributes_named(f"{name}.step", "state", state):
            return motion.step(state, inputs, interval, Vector.of(w))

    def jacobian_of(interval: Any, w: Any) -> Any:
        after = step(interval, w)

        def deviation(*values: Scalar) -> list[Scalar]:
            return local(
                after, motion.step(rebuild(values[: len(point)]), inputs, interval, Vector.of(values[len(point) :]))
            )

        return densify(linearise(deviation, [*point, *w])[1], len(components), jnp.zeros(()))

    jitted_step, jitted_jacobian = jax.jit(step), jax.jit(jacobian_of)
    for interval in (jnp.asarray(0.0), jnp.asarray(dt)):
        for w in (list(_arrays(draw)) for draw in noise):
            after = _call(f"{name}.step", jitted_step, interval, w)
            # jax's stubs give a tree structure no typed equality.
            same_tree = jax.tree_util.tree_structure(after) == jax.tree_util.tree_structure(state)  # type: ignore[operator]
            if not same_tree or _shapes(after) != _shapes(state):
                raise BrokenContract(
                    f"{name}.step returns {_kind(after)}, expected a state like the given one: {_kind(state)}"
                )
            if float(interval) == 0 and not _same(after, state):
                shift = np.abs(np.array([float(x) for x in local(state, after)]))
                raise BrokenContract(
                    f"{name}.step with dt = 0 changes {components[int(np.argmax(shift))]} by {shift.max():.3g}, "
                    "expected a bit-identical state whatever the noise; usual fix: a factor that is zero "
                    "for dt = 0 in each term"
                )
            _require_finite(f"{name}.step at dt = {interval} s", jnp.stack(coordinates(after)[0]), components)
            jacobian = _call(f"{name}.step", jitted_jacobian, interval, w)
            _require_finite(f"the derivative of {name}.step at dt = {interval} s", jacobian, components)
    if not _same(after, jax.jit(lambda *x: step(*x))(interval, w)):
        raise BrokenContract(f"{name}.step gives other numbers when traced again; expected all its randomness in w")


def check_sensor(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None = None, reported: Sequence[float] = (), seed: int = 0
) -> None:
    """Raises `BrokenContract` unless `sensor` fulfils its contract at `view`, a `motion.view` of a state.

    Contract: one predicted and one whitened number per channel; a masked channel has no influence and adds nothing to
    `nis_dof`; with all channels masked the likelihood is 1; residuals and derivatives are finite for outliers; the
    density integrates to 1 over readings, for up to three channels at a time, the others masked. `reported`: the noise
    columns of one reading. The integral over an angle needs noise well below half a turn.
    """
    name, m = type(sensor).__name__, len(sensor.channels)
    names = [channel.name for channel in sensor.channels]
    sensor, view = freeze(_arrays(sensor)), _arrays(view)
    for field in sensor.view_fields:
        if not hasattr(view, field):
            raise BrokenContract(
                f"{name}.measure reads '{field}' of the view; expected a view with it, found {type(view).__name__}; "
                "usual fix: the `view` of a motion whose state has it"
            )
    inputs = _given(f"{name}.measure", sensor.inputs, m, view, inputs)
    noise: Any = jnp.asarray(reported, float)
    point, rebuild = coordinates(view)
    rng = np.random.default_rng(seed)

    def measure() -> list[Scalar]:
        with _attributes_named(f"{name}.measure", "view", view):
            return list(sensor.measure(view, inputs))

    predicted = _call(f"{name}.measure", jax.jit(measure))
    if len(predicted) != m or any(jnp.shape(p) != () for p in predicted):
        raise BrokenContract(
            f"{name}.measure returns numbers of shapes {_shapes(predicted)}, expected {m} scalars: {', '.join(names)}"
        )
    predicted = np.array([float(p) for p in predicted])
    _require_finite(f"{name}.measure", predicted, names)

    @jax.jit
    def residual_of(values: Any, seen: Any) -> Residual:
        residual = sensor.residual(Reading(values, seen, noise), list(sensor.measure(view, inputs)))
        return residual._replace(whitened=list(residual.whitened))

    def residual(offset: Any, seen: Any) -> tuple[np.ndarray, float, float]:
        result = _call(f"{name}.residual", residual_of, _arrays(predicted + offset), np.asarray(seen, bool))
        if len(result.whitened) != m:
            raise BrokenContract(
                f"{name}.residual has {len(result.whitened)} whitened numbers, expected one per channel, {m}"
            )
        return np.array([float(r) for r in result.whitened]), float(result.log_scale), float(result.nis_dof)

    whitened, _, nis_dof = residual(np.zeros(m), np.ones(m))
    if np.abs(whitened).max() > 1e-3:
        raise BrokenContract(f"{name}.residual of a reading equal to the prediction is {whitened}, expected zeros")
    if not 0 < nis_dof <= m:
        raise BrokenContract(
            f"{name}.residual counts {nis_dof:g} numbers with all channels seen, expected between 1 and {m}"
        )
    for seen in (np.zeros(m, bool), *(np.arange(m) != k for k in range(m)), *(rng.random((4, m)) < 0.5)):
        _check_mask(name, residual, rng.normal(size=m) * 0.1, seen)

    @jax.jit
    def jacobian_of(values: Any, seen: Any) -> Any:
        def whitened_of(*x: Scalar) -> list[Scalar]:
            return list(
                sensor.residual(Reading(values, seen, noise), list(sensor.measure(rebuild(x), inputs))).whitened
            )

        return densify(linearise(whitened_of, point)[1], len(point), jnp.zeros(()))

    for offset in (0.0, FAR, -FAR):
        for seen in (np.ones(m, bool), np.zeros(m, bool)):
            _require_finite(f"{name}.residual of a reading off by {offset:g}", residual(offset, seen)[0], names)
            jacobian = jacobian_of(_arrays(predicted + offset), seen)
            _require_finite(f"the derivative of {name}.residual of a reading off by {offset:g}", jacobian, names)

    def log_density(values: Any, seen: Any) -> Any:
        belief = Gaussian(view, tuple(jnp.zeros_like(point[0]) for _ in range(len(point) * (len(point) + 1) // 2)))
        return ExtendedKalman().update(belief, Still(), sensor, Reading(values, seen, noise), inputs)[1].log_likelihood

    densities = jax.jit(jax.vmap(log_density, in_axes=(0, None)))
    by_reading = jax.jit(jax.jacfwd(lambda z, s: jnp.stack(residual_of(z, s).whitened)))
    dof = residual_of(_arrays(predicted), np.ones(m, bool)).dof
    dof = None if dof is None else float(dof)
    wraps = np.array([channel.wraps for channel in sensor.channels])
    for seen in _windows(m):
        n_redundant = round(seen.sum() - residual(np.zeros(m), seen)[2])
        free = np.flatnonzero(seen)[n_redundant:]
        if not len(free):
            continue
        jacobian = np.array(by_reading(_arrays(predicted), seen), float)[:, free]

        def density(readings: Any, seen: np.ndarray = seen) -> Any:
            return densities(_arrays(readings), seen)

        mass, wrapped = integral(density, predicted, free, jacobian, wraps, dof)
        if not abs(mass - 1) < 2e-3 + wrapped:
            raise BrokenContract(
                f"{name}: the density of a reading integrates to {mass:.4g} over "
                f"{', '.join(names[j] for j in free)}, expected 1; usual fix: log_scale is −½ log 2π − log sigma for "
                "each channel seen, of the sigma that whitens"
            )


@contextmanager
def _attributes_named(what: str, role: str, given: Any) -> Iterator[None]:
    """Raises `BrokenContract` for an attribute that `given`, the view or the state, or a vector lacks."""
    try:
        yield
    except AttributeError as error:
        if error.obj is given:
            fields = ", ".join(dict.fromkeys(part.partition(".")[0] for part in component_names(given)))
            has = f"the {role}, a {type(given).__name__}, which has {fields}"
        elif isinstance(error.obj, Vector):
            has = f"a vector; expected its components by number, [0] to [{len(error.obj) - 1}]"
        else:
            raise
        raise BrokenContract(f"{what} reads '{error.name}' of {has}") from None


def _given(what: str, declared: Sequence[Input], channels: int, view: Any, inputs: Inputs | None) -> GivenInputs:
    """The inputs as arrays; raises `BrokenContract` for a declared one that is missing or of another shape."""
    given = GivenInputs(_arrays(dict(inputs or {})), what)
    planar = len(getattr(view, "position", ())) == 2
    for one in declared:
        expected = f"expected {one.name}, shape {one.row_shape(channels)}, {one.unit or '1'}: {one.about}"
        if one.name not in given and (one.need is Need.ALWAYS or (one.need is Need.PLANAR and planar)):
            raise BrokenContract(
                f"{what} reads the input '{one.name}', found {', '.join(given) or 'no input'}; {expected}; usual fix: "
                f"inputs={{'{one.name}': …}} in the call of this check"
            )
        if one.name in given and np.shape(given[one.name]) != one.row_shape(channels):
            raise BrokenContract(
                f"{what} reads the input '{one.name}', found shape {np.shape(given[one.name])}; {expected}; usual fix: "
                "the input of one row"
            )
    return given


def _check_mask(name: str, residual: Callable[..., Any], offset: np.ndarray, seen: np.ndarray) -> None:
    """Raises unless a masked channel has no influence: its whitened residual is 0, and its value changes nothing."""
    whitened, log_scale, nis_dof = residual(offset, seen)
    if np.any(whitened[~seen] != 0):
        raise BrokenContract(f"{name}.residual is {whitened} where seen is {seen}, expected 0 for a masked channel")
    if nis_dof > seen.sum():
        raise BrokenContract(f"{name}.residual counts {nis_dof:g} numbers where {seen.sum()} channels were seen")
    if not seen.any() and (nis_dof != 0 or log_scale != 0):
        raise BrokenContract(
            f"{name}.residual with no channel seen has nis_dof {nis_dof:g} and log_scale {log_scale:.4g}, "
            "expected 0 and 0"
        )
    other = residual(np.where(seen, offset, offset + 3.0), seen)
    if not (np.array_equal(whitened, other[0]) and (log_scale, nis_dof) == other[1:]):
        raise BrokenContract(
            f"{name}.residual changes with the value of a masked channel (seen: {seen}), expected no change"
        )


def _windows(m: int) -> Iterator[np.ndarray]:
    """Masks with one, two and three neighbouring channels seen."""
    for size in range(1, min(m, 3) + 1):
        for start in range(m - size + 1):
            yield (np.arange(m) >= start) & (np.arange(m) < start + size)


def _arrays(tree: Tree) -> Tree:
    """The tree with its floats as arrays of jax's default precision, as in a run."""
    kind = jnp.zeros(0).dtype

    def cast(x: Any) -> Any:
        if isinstance(x, (bool, int)) or not (hasattr(x, "dtype") or isinstance(x, float)):
            return x
        return jnp.asarray(x, kind) if np.issubdtype(np.asarray(x).dtype, np.floating) else jnp.asarray(x)

    return jax.tree_util.tree_map(cast, tree)


def _call(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a jitted function; raises `BrokenContract` if jax cannot trace it, or for a missing input."""
    try:
        return function(*arguments)
    except MissingInputError as missing:
        raise BrokenContract(
            f"{missing.reader} reads the input '{missing.name}', which is neither declared nor given; expected it in "
            "the property `inputs`, and in the argument `inputs` of this check; usual fix: add it to both"
        ) from None
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        reason = str(error).splitlines()[0]
        raise BrokenContract(
            f"{what} cannot be traced ({reason}); usual fix: jnp.where instead of if, jnp instead of math and numpy"
        ) from error


def _same(a: Any, b: Any) -> bool:
    """Whether the numbers of two trees are bit-identical."""
    leaves = zip(jax.tree_util.tree_leaves(a), jax.tree_util.tree_leaves(b), strict=True)
    return all(np.array_equal(np.asarray(x), np.asarray(y)) for x, y in leaves)


def _shapes(tree: Any) -> list[tuple[int, ...]]:
    return [np.shape(x) for x in jax.tree_util.tree_leaves(tree)]


def _kind(tree: Any) -> str:
    return f"{type(tree).__name__} with shapes {_shapes(tree)}"


def _require_finite(what: str, values: Any, names: Sequence[str]) -> None:
    """Raises for the first non-finite entry; `values`: one row, or one number, per name."""
    bad = np.argwhere(~np.isfinite(np.asarray(values)))
    if len(bad):
        raise BrokenContract(
            f"{what} is not finite at {names[bad[0, 0]]}; usual fix: jnp.where around the argument of a root, "
            "division or arctangent, not only around its result"
        )


POINTS = 4096
"""Readings per call of the density: 4096 for one channel, 64 × 64 for two, an eighth of 32 × 32 × 32 for three."""


def integral(
    log_density: Callable[[np.ndarray], Array],
    predicted: Float[np.ndarray, " m"],
    free: Int[np.ndarray, " free"],
    jacobian: Float[np.ndarray, "channels free"],
    wraps: Bool[np.ndarray, " m"],
    dof: float | None,
) -> tuple[float, float]:
    """∫ density over the free channels, the others fixed at the prediction, and the probability lost by wrapping.

    Trapezoidal rule in s with u = sinh s the whitened reading: exponentially accurate for the normal density, and far
    into the tails of Student's t (`dof`). `jacobian`: ∂whitened/∂reading over the free channels.
    """
    k = len(free)
    rows = jacobian[np.any(jacobian != 0, axis=1)]
    factor = rows if len(rows) == k else np.linalg.qr(jacobian)[1]
    if not np.all(np.isfinite(factor)) or abs(np.linalg.det(factor)) < 1e-30:
        return math.nan, 0.0
    inverse = np.linalg.inv(factor)
    reach = math.asinh(8.0) if dof is None else min(3.0 + 16.0 / dof, 18.0)
    s = np.linspace(-reach, reach, {1: POINTS, 2: 64, 3: 32}[k])
    grid = np.stack(np.meshgrid(*[s] * k, indexing="ij"), axis=-1).reshape(-1, k)
    offsets = np.sinh(grid) @ inverse.T
    values = np.tile(predicted, (len(grid), 1))
    values[:, free] += offsets
    blocks = values.reshape(-1, POINTS, len(predicted))
    density = np.exp(np.concatenate([np.asarray(log_density(block), float) for block in blocks]))
    inside = np.all((np.abs(offsets) <= np.pi) | ~wraps[free], axis=1)
    weight = np.prod(np.cosh(grid), axis=1) * (s[1] - s[0]) ** k * abs(np.linalg.det(inverse))
    scales = np.sqrt(np.sum(inverse**2, axis=1))[wraps[free]]
    return float(np.sum(density * weight * inside)), sum(beyond(np.pi / scale, dof) for scale in scales)


def beyond(x: float, dof: float | None) -> float:
    """The probability beyond ± x of the standard normal, or of Student's t with `dof` degrees of freedom."""
    return (
        math.erfc(x / math.sqrt(2)) if dof is None else float(scipy.special.betainc(dof / 2, 0.5, dof / (dof + x * x)))
    )
