"""Position fixes of a locating system: the sensor with its noise, its outliers and its latency, start and tracker.

A fix that comes late shows where the tag was: z(t) = p(t) − v(t)·latency, straight motion for so long. The state is
that of the row's time; `FixTracker.dated` gives it back at the time for which a late fix speaks, where it is known
best, and says which time that is.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, SparseRow, Vector, congruence, diagonal, total, triangle
from trackers.core.ekf import Gaussian
from trackers.core.estimates import Estimates
from trackers.core.motion import Accelerated, Kinematic, Noise
from trackers.core.recording import Batch, Row
from trackers.core.scan import Output, Score
from trackers.core.sensor import LOG_2PI, AbstractSensor, Channel, Reading, Residual, log_peak, placed
from trackers.core.start import AbstractStart
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import Tracker
from trackers.core.tunable import Covariance, Real, Scale
from trackers.core.whitening import whitened

FIXES = "fixes"

PATIENT = TrackLossPolicy(nis_limit=1e3, max_gap=10.0)
"""Errors of real fixes last for seconds: a large running NIS is no sign of a lost track there."""


class AbstractFixSensor(AbstractSensor):
    """x, y, z, m, of a tag, `latency` seconds after it was there.

    Its noise stands beside what the device reports (three variances, m²), whose root is scaled by `reported_std_scale`. `dof`:
    degrees of freedom of Student's t, or None for normal noise. Input: `height`, m, for a planar state.
    """

    reported_std_scale: eqx.AbstractVar[Noise]
    dof: eqx.AbstractVar[Noise | None]
    latency: eqx.AbstractVar[Noise]

    @abstractmethod
    def noise(self) -> list[list[Scalar]]:
        """The covariance of the channels, m², row by row."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """x, y and z."""
        return Channel("x", "m"), Channel("y", "m"), Channel("z", "m")

    def measure(self, view: Any, inputs: Any) -> list[Scalar]:
        late = [-v * self.latency.value for v in view.velocity]
        # A motion over the floor has no vertical velocity: its height counts as the same all the while.
        places = list(placed(view.position, inputs))
        return [p + late[k] if k < len(late) else p for k, p in enumerate(places)]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Channel by channel given those before, whitened by the Cholesky factor of the covariance of what was seen."""
        noise = self.noise()
        for k, variance in enumerate(reading.reported):
            noise[k][k] = noise[k][k] + variance * self.reported_std_scale.value**2
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        values, sigmas = whitened(differences, noise, list(reading.seen))
        dof = None if self.dof is None else self.dof.value
        peak = -0.5 * LOG_2PI if dof is None else log_peak(dof)
        seen = list(zip(reading.seen, sigmas, strict=True))
        log_scale = total(jnp.where(s, peak - jnp.log(sigma), 0.0) for s, sigma in seen)
        nis_dof = total(jnp.where(s, jnp.ones_like(sigma), 0.0) for s, sigma in seen)
        return Residual(values, log_scale, nis_dof, dof=dof)


class FixSensor(AbstractFixSensor):
    """Fixes with independent errors: `sigma_horizontal` m of x and of y, `sigma_vertical` m of z."""

    sigma_horizontal: Noise
    sigma_vertical: Noise
    reported_std_scale: Noise
    dof: Noise | None
    latency: Noise

    def __init__(self, sigma_horizontal: float, sigma_vertical: float, dof: float | None = None, latency: float = 0.0):
        self.sigma_horizontal, self.sigma_vertical = Scale(sigma_horizontal, "m"), Scale(sigma_vertical, "m")
        self.reported_std_scale, self.dof, self.latency = Scale(1.0), *_extras(dof, latency)

    def noise(self) -> list[list[Scalar]]:
        across, up = self.sigma_horizontal.value**2, self.sigma_vertical.value**2
        return [[across, 0.0, 0.0], [0.0, across, 0.0], [0.0, 0.0, up]]


class CorrelatedFixSensor(AbstractFixSensor):
    """Fixes whose errors hang together: `covariance` (3, 3) m², as measured from a tag at rest."""

    covariance: Noise
    reported_std_scale: Noise
    dof: Noise | None
    latency: Noise

    def __init__(self, covariance: Any, dof: float | None = None, latency: float = 0.0):
        self.covariance = Covariance(covariance, "m^2")
        self.reported_std_scale, self.dof, self.latency = Scale(1.0), *_extras(dof, latency)

    def noise(self) -> list[list[Scalar]]:
        return [[self.covariance.value[i, j] for j in range(3)] for i in range(3)]


def _extras(dof: float | None, latency: float) -> tuple[Scale | None, Real]:
    return None if dof is None else Scale(dof), Real(latency, "s", typical=0.5)


class FixStart(AbstractStart):
    """The first fix with x and y; `sigma_position` m, `sigma_velocity` m/s: how far off it may be.

    `planar`: over the floor alone. `velocities`: the number of the state's velocities; `accelerations`: of its
    accelerations, m/s², known to `sigma_velocity` per second. A fix without z starts anywhere within 10 km of zero.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    planar: bool = eqx.field(static=True)
    velocities: int = eqx.field(static=True)
    accelerations: int = eqx.field(static=True, default=0)

    def can_start(self, row: Row) -> Scalar:
        seen = row.readings[FIXES].seen
        return seen[0] & seen[1]

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        # One array, whose columns are looked up together; what a row holds needs no search.
        reading = row.readings[FIXES]
        return jnp.stack(
            [*(reading.values[k] for k in range(3)), jnp.where(reading.seen[2], 1.0, 0.0).astype(row.dt.dtype)]
        )

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero = jnp.zeros_like(candidate[0])
        near, rate = self.sigma_position.value**2, self.sigma_velocity.value**2
        spread = [near, near, jnp.where(candidate[3] > 0.5, near, 1e8)][:n]
        position, velocity = Vector(*(candidate[k] for k in range(n))), Vector(*[zero] * self.velocities)
        cov = diagonal([*spread, *[rate] * (self.velocities + self.accelerations)], zero)
        if self.accelerations:
            return Gaussian(Accelerated(position, velocity, Vector(*[zero] * self.accelerations)), cov)
        return Gaussian(Kinematic(position, velocity), cov)


class FixTracker(Tracker):
    """A tracker of fixes whose estimates are dated back by their latency, and judged by the truth of that time."""

    def accumulate(self, batch: Batch, score: Score) -> tuple[Any, ...]:
        latency = self.sensors[FIXES].latency.value  # type: ignore[attr-defined]

        def at_valid_time(output: Output, truth: dict[str, tuple[Any, Any]]) -> tuple[Any, ...]:
            mean = output.mean._replace(position=position_before(output.mean, latency))
            return score(output._replace(mean=mean, cov=cov_before(output.mean, output.cov, latency)), truth)

        return Tracker.accumulate(self, batch._replace(truth=truth_before(batch, latency)), at_valid_time)

    def at_valid_time(self, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
        """The times that late fixes speak of, and the position then: p − v·latency with its covariance."""
        return shifted_back_all(self.sensors[FIXES], times, estimates)


def position_before(mean: Any, seconds: Scalar) -> Vector:
    """Where straight motion had a state `seconds` before; what has no velocity stays."""
    moving = list(zip(mean.position, mean.velocity, strict=False))
    return Vector(*(p - v * seconds for p, v in moving), *list(mean.position)[len(moving) :])


def cov_before(mean: Any, upper: Sequence[Scalar], seconds: Scalar) -> tuple[Scalar, ...]:
    """The covariance of a state whose position is that of `position_before`: upper triangles before and after."""
    first = len(mean.position)
    rows: list[SparseRow] = [{k: 1.0} for k in range(int((8 * len(upper) + 1) ** 0.5) // 2)]
    for k in range(min(first, len(mean.velocity))):
        rows[k][first + k] = -seconds
    return congruence(rows, upper, [{} for _ in rows])


def truth_before(batch: Batch, seconds: Scalar) -> dict[str, tuple[Any, Any]]:
    """The truth of a batch `seconds` before each row, linear between rows and differentiable in `seconds`."""
    # Padding has no time of its own; that of the last row is to be that row's alone.
    times = jnp.cumsum(jnp.where(batch.valid, batch.dt, jnp.ones_like(batch.dt)), axis=0)

    def trajectory(times: Any, values: Any, known: Any) -> tuple[Any, Any]:
        before = times - seconds
        columns = [jnp.interp(before, times, values[:, k]) for k in range(values.shape[1])]
        certain = jnp.interp(before, times, known.astype(times.dtype)) > 1 - 1e-6
        return jnp.stack(columns, axis=1), certain & (before >= times[0]) & (before <= times[-1])

    trajectories = jax.vmap(trajectory, in_axes=-1, out_axes=-1)
    return {name: trajectories(times, *(jnp.asarray(x) for x in pair)) for name, pair in batch.truth.items()}


def shifted_back_all(sensor: Any, times: np.ndarray, estimates: Estimates) -> tuple[np.ndarray, Estimates]:
    """Times and estimates less the latency of a fix sensor; as they are where it has none."""
    latency = float(sensor.latency.value)
    return (times, estimates) if latency == 0 else (times - latency, shifted_back(estimates, latency))


def shifted_back(estimates: Estimates, seconds: float) -> Estimates:
    """The estimates with each position where straight motion had it `seconds` before; velocities stay."""
    mean = estimates.mean
    n, first = estimates.dimension, len(mean.position)
    back = np.eye(n)
    for k in range(min(first, len(mean.velocity))):
        back[k, first + k] = -seconds
    cov = back @ estimates.covariance @ back.T
    upper = np.stack([cov[..., i, j] for i, j in triangle(n)]).astype(estimates.cov_upper.dtype)
    return Estimates(
        mean._replace(position=position_before(mean, seconds)),
        upper,
        *(getattr(estimates, k) for k in ("log_likelihood", "nis", "nis_dof", "wrapped", "status")),
    )
