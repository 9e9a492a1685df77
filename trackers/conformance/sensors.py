"""The contract of a sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.conformance.contract import BrokenContract, Check, Report, report, require_part
from trackwright.trackers.conformance.density import integral
from trackwright.trackers.conformance.differences import central_differences
from trackwright.trackers.conformance.traced import (
    arrays,
    attributes_named,
    called,
    known_inputs,
    require_finite,
    shapes_of,
)
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.model.algebra import Scalar, Vector, densify
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.linearise import linearise
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Residual
from trackwright.trackers.core.model.state import State, component_names, coordinates, retract
from trackwright.trackers.core.model.tunable import freeze

FAR = 1e6
"""Error of an outlier in units of a channel; the square of its whitened residual is still finite in float32."""


class Still(AbstractMotion):
    """A motion that leaves the state unchanged."""

    @property
    def noise_dimension(self) -> int:
        return 0

    def step(self, state: State, inputs: Inputs, dt: Scalar, w: Vector) -> State:
        return state


def check_sensor(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None = None, reported: Sequence[float] = (), seed: int = 0
) -> Report:
    """What `sensor_checks` find."""
    return report(sensor_checks(sensor, view, inputs, reported, seed))


def sensor_checks(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None = None, reported: Sequence[float] = (), seed: int = 0
) -> list[Check]:
    """The checks of a sensor at `view`, a `motion.view` of a state, with the known `inputs` of one row.

    One predicted and one whitened number per channel; a masked channel has no influence and adds nothing to `nis_dof`;
    with all channels masked the likelihood is 1; residuals and derivatives are finite for outliers, and derivatives
    are difference quotients and not zero throughout; the density integrates to 1 over readings, for up to three
    channels at a time, the others masked. `reported`: the noise columns of one reading. The integral over an angle
    needs noise well below half a turn. Raises UnusableInput for an object of another kind.
    """
    require_part("check_sensor", sensor)
    name, m = type(sensor).__name__, len(sensor.channels)
    names = [channel.name for channel in sensor.channels]
    single, here = freeze(arrays(sensor)), arrays(view)
    noise: Any = jnp.asarray(reported, float)
    point, rebuild = coordinates(here)

    @cache
    def given() -> Inputs:
        return known_inputs(f"{name}.measure", sensor.inputs, m, here, inputs)

    def measure() -> list[Scalar]:
        with attributes_named(f"{name}.measure", "view", here):
            return list(single.measure(here, given()))

    @cache
    def predicted() -> Float[np.ndarray, " m"]:
        for field in sensor.view_fields:
            if not hasattr(here, field):
                raise BrokenContract(
                    f"{name}.measure reads '{field}' of the view; expected a view with it, found "
                    f"{type(here).__name__}; usual fix: the `view` of a motion whose state has it"
                )
        given()  # before anything is traced
        values = called(f"{name}.measure", jax.jit(measure))
        if len(values) != m or any(jnp.shape(p) != () for p in values):
            raise BrokenContract(
                f"{name}.measure returns numbers of shapes {shapes_of(values)}, expected {m} scalars: "
                f"{', '.join(names)}; usual fix: one number per channel, in their order"
            )
        numbers = np.array([float(p) for p in values])
        require_finite(f"{name}.measure", numbers, names)
        return numbers

    def whitening(reading: Reading, x: Sequence[Scalar]) -> Residual:
        result = single.residual(reading, list(single.measure(rebuild(x), given())))
        return result._replace(whitened=list(result.whitened))

    @jax.jit
    def residual_of(values: Any, seen: Any) -> Residual:
        return whitening(Reading(values, seen, noise), point)

    @jax.jit
    def jacobian_of(values: Any, seen: Any) -> Any:
        rows = linearise(lambda *x: list(whitening(Reading(values, seen, noise), x).whitened), point)[1]
        return densify(rows, len(point), jnp.zeros(()))

    def residual(offset: Any, seen: Any) -> tuple[np.ndarray, float, float]:
        values = arrays(predicted() + offset)
        result = called(f"{name}.residual", residual_of, values, np.asarray(seen, bool))
        if len(result.whitened) != m:
            raise BrokenContract(
                f"{name}.residual has {len(result.whitened)} whitened numbers, expected one per channel, {m}; usual "
                "fix: zero for a channel that is masked"
            )
        return np.array([float(r) for r in result.whitened]), float(result.log_scale), float(result.nis_dof)

    def check_measure() -> None:
        predicted()

    def check_residual() -> None:
        whitened, _, nis_dof = residual(np.zeros(m), np.ones(m))
        if np.abs(whitened).max() > 1e-3:
            raise BrokenContract(
                f"{name}.residual of a reading equal to the prediction is {whitened}, expected zeros; usual fix: "
                "reading − prediction, wrapped where it is an angle"
            )
        if not 0 < nis_dof <= m:
            raise BrokenContract(
                f"{name}.residual counts {nis_dof:g} numbers with all channels seen, expected between 1 and {m}; usual "
                "fix: nis_dof is the number of channels seen, less what they have in common"
            )

    def check_mask() -> None:
        rng = np.random.default_rng(seed)
        for seen in (np.zeros(m, bool), *(np.arange(m) != k for k in range(m)), *(rng.random((4, m)) < 0.5)):
            offset = rng.normal(size=m) * 0.1
            _compare_masked(name, residual(offset, seen), residual(np.where(seen, offset, offset + 3.0), seen), seen)

    def check_finite() -> None:
        for offset in (0.0, FAR, -FAR):
            for seen in (np.ones(m, bool), np.zeros(m, bool)):
                require_finite(f"{name}.residual of a reading off by {offset:g}", residual(offset, seen)[0], names)
                jacobian = jacobian_of(arrays(predicted() + offset), seen)
                require_finite(f"the derivative of {name}.residual of a reading off by {offset:g}", jacobian, names)

    def check_derivatives() -> str:
        with jax.enable_x64(True):
            by_jax, by_differences = _whitened_jacobians(freeze(arrays(sensor)), arrays(view), inputs, reported, name)
        error, size = np.abs(by_jax - by_differences), max(np.abs(by_differences).max(), 1e-9)
        if not error.max() <= 1e-4 * size:
            channel, component = np.unravel_index(int(np.argmax(error)), error.shape)
            raise BrokenContract(
                f"the derivative of {name}'s whitened {names[channel]} by {component_names(here)[component]} is "
                f"{by_jax[channel, component]:.6g}, by difference quotients {by_differences[channel, component]:.6g}; "
                "usual fix: no stop_gradient, rounding or custom derivative in `measure` and `residual`"
            )
        return f"equal to difference quotients within {error.max() / size:.0e}"

    def log_density(values: Any, seen: Any) -> Any:
        belief = Gaussian(here, tuple(jnp.zeros_like(point[0]) for _ in range(len(point) * (len(point) + 1) // 2)))
        reading = Reading(values, seen, noise)
        return ExtendedKalman().update(belief, Still(), single, reading, given())[1].log_likelihood

    def check_density() -> str:
        densities = jax.jit(jax.vmap(log_density, in_axes=(0, None)))
        by_reading = jax.jit(jax.jacfwd(lambda z, s: jnp.stack(residual_of(z, s).whitened)))
        dof = residual_of(arrays(predicted()), np.ones(m, bool)).dof
        dof = None if dof is None else float(dof)
        wraps, worst = np.array([channel.wraps for channel in sensor.channels]), 0.0
        unread = ~np.any(np.asarray(by_reading(arrays(predicted()), np.ones(m, bool))), axis=0)
        for seen in _windows(m):
            if np.any(seen & unread):
                continue
            n_redundant = round(seen.sum() - residual(np.zeros(m), seen)[2])
            free = np.flatnonzero(seen)[n_redundant:]
            if not len(free):
                continue
            jacobian = np.array(by_reading(arrays(predicted()), seen), float)[:, free]

            def density(readings: Any, seen: np.ndarray = seen) -> Any:
                return densities(arrays(readings), seen)

            mass, wrapped = integral(density, predicted(), free, jacobian, wraps, dof)
            if not abs(mass - 1) < 2e-3 + wrapped:
                raise BrokenContract(
                    f"{name}: the density of a reading integrates to {mass:.4g} over "
                    f"{', '.join(names[j] for j in free)}, expected 1; usual fix: log_scale is −½ log 2π − log sigma "
                    "for each channel seen, of the sigma that whitens"
                )
            worst = max(worst, abs(mass - 1))
        return f"integrates to 1 within {worst:.0e}"

    begun = Check("measure", check_measure)
    whitened = Check("residual", check_residual, begun)
    mask = Check("mask", check_mask, whitened)
    finite = Check("finite", check_finite, whitened)
    return [
        begun,
        whitened,
        mask,
        finite,
        Check("derivatives", check_derivatives, finite),
        Check("density", check_density, mask),
    ]


def _compare_masked(name: str, result: Any, other: Any, seen: Bool[np.ndarray, " m"]) -> None:
    """Raises unless a masked channel has no influence: its whitened residual is 0, and its value changes nothing."""
    whitened, log_scale, nis_dof = result
    fix = "usual fix: jnp.where(seen, …, 0.0) for each channel, as `independent` does"
    if np.any(whitened[~seen] != 0):
        raise BrokenContract(
            f"{name}.residual is {whitened} where seen is {seen}, expected 0 for a masked channel; {fix}"
        )
    if nis_dof > seen.sum():
        raise BrokenContract(
            f"{name}.residual counts {nis_dof:g} numbers where {seen.sum()} channels were seen, expected no more; {fix}"
        )
    if not seen.any() and (nis_dof != 0 or log_scale != 0):
        raise BrokenContract(
            f"{name}.residual with no channel seen has nis_dof {nis_dof:g} and log_scale {log_scale:.4g}, "
            f"expected 0 and 0; {fix}"
        )
    if not (np.array_equal(whitened, other[0]) and (log_scale, nis_dof) == other[1:]):
        raise BrokenContract(
            f"{name}.residual changes with the value of a masked channel (seen: {seen}), expected no change; {fix}"
        )


def _windows(m: int) -> Iterator[Bool[np.ndarray, " m"]]:
    """Masks with one, two and three neighbouring channels seen."""
    for size in range(1, min(m, 3) + 1):
        for start in range(m - size + 1):
            yield (np.arange(m) >= start) & (np.arange(m) < start + size)


def _whitened_jacobians(
    sensor: AbstractSensor, view: Any, inputs: Inputs | None, reported: Sequence[float], name: str
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n"]]:
    """∂whitened/∂view by the filter's linearisation and by central differences, at a reading a little off."""
    m = len(sensor.channels)
    known = known_inputs(f"{name}.measure", sensor.inputs, m, view, inputs)
    values = jnp.stack([jnp.asarray(z) for z in sensor.measure(view, known)]) + 0.01 * np.cos(np.arange(m))
    reading = Reading(values, np.ones(m, bool), jnp.asarray(reported, float))
    point, rebuild = coordinates(view)

    def whitened(moved: Any) -> list[Scalar]:
        return list(sensor.residual(reading, list(sensor.measure(moved, known))).whitened)

    shifted = jax.jit(jax.vmap(lambda change: jnp.stack(whitened(retract(view, list(change))))))
    n, what = len(point), f"{name}.measure"
    by_differences = central_differences(what, shifted, n)
    # Zero also away from a view where it may vanish, as that of a speed at rest.
    if not by_differences.any() and not central_differences(what, lambda x: shifted(x + np.cos(np.arange(n))), n).any():
        raise BrokenContract(
            f"the derivative of {what} by every component of the view is zero, so that no reading changes an estimate; "
            "usual fix: compute the reading from the view, without rounding or numbers of another place"
        )
    rows = jax.jit(lambda: linearise(lambda *x: whitened(rebuild(x)), point)[1])()
    return np.asarray(densify(rows, len(point), jnp.zeros(()))), by_differences
