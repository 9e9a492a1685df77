"""Position fixes of a locating system: sensor models with outliers and latency, and a start.

A fix with latency measures an earlier position, z(t) = p(t) − v(t)·latency for straight motion.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal, total
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import HEIGHT, Input, Inputs
from trackwright.trackers.core.model.motion import Accelerated, Kinematic, Noise
from trackwright.trackers.core.model.sensor import (
    LOG_2PI,
    AbstractDelayedSensor,
    AbstractSensor,
    Channel,
    Reading,
    Residual,
    Row,
    position_in_space,
    student_t_log_peak,
)
from trackwright.trackers.core.model.tunable import Considered, Covariance, Real, Scale
from trackwright.trackers.core.run.track_loss import TrackLossPolicy, TrackScorePolicy
from trackwright.trackers.recordings.checks.rules import without_height
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Trajectories, known_heights, trajectories_of

FIXES = "fixes"
# Errors of real fixes are correlated over seconds, so a large mean NIS is no evidence of track loss.
PATIENT = TrackLossPolicy(nis_limit=1e3, max_gap=10.0)
# Particles that start at a wild fix are too far from later ones to reach them; errors of metres may last.
ELSEWHERE = TrackScorePolicy(25.0, "m", away=5.0)


class AbstractFixSensor(AbstractDelayedSensor):
    """x, y, z of a tag, m, measured `latency` s before the row's time.

    A latency that nobody has measured has the standard deviation `latency_std`, s, in reported covariances; else 0.

    The covariance `noise` adds to the reported variances (three, m²), whose square roots are scaled by
    `reported_std_scale`. `dof`: degrees of freedom of Student's t, None for normal noise. Input: `height`, m, for a
    planar state.
    """

    reported_std_scale: eqx.AbstractVar[Noise]
    dof: eqx.AbstractVar[Noise | None]

    view_fields: ClassVar[tuple[str, ...]] = ("position", "velocity")

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (HEIGHT,)

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The variances of x, y and z, m²."""
        return tuple(Channel(f"variance_{axis}", "m^2") for axis in "xyz")

    @abstractmethod
    def noise(self) -> list[list[Scalar]]:
        """The covariance matrix of the channels, m²."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """x, y and z."""
        return Channel("x", "m"), Channel("y", "m"), Channel("z", "m")

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        lag = [-v * self.latency.value for v in view.velocity]
        # A planar motion has no vertical velocity: its height is taken as constant over the latency.
        position = list(position_in_space(view.position, inputs))
        return [p + lag[k] if k < len(lag) else p for k, p in enumerate(position)]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Differences whitened by the Cholesky factor of the covariance of the channels seen."""
        noise = self.noise()
        for k, variance in enumerate(reading.reported):
            noise[k][k] = noise[k][k] + variance * self.reported_std_scale.value**2
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        return correlated(differences, noise, list(reading.seen), None if self.dof is None else self.dof.value)


def correlated(
    differences: Sequence[Scalar],
    covariance: Sequence[Sequence[Scalar]],
    seen: Sequence[Scalar],
    dof: Scalar | None = None,
) -> Residual:
    """The residual of channels with correlated noise: see `whiten`, and `independent` for channels without."""
    values, sigmas = whiten(differences, covariance, seen)
    peak = -0.5 * LOG_2PI if dof is None else student_t_log_peak(dof)
    log_scale = total(jnp.where(s, peak - jnp.log(sigma), 0.0) for s, sigma in zip(seen, sigmas, strict=True))
    nis_dof = total(jnp.where(s, jnp.ones_like(sigma), 0.0) for s, sigma in zip(seen, sigmas, strict=True))
    return Residual(values, log_scale, nis_dof, dof=dof)


def whiten(
    differences: Sequence[Scalar], covariance: Sequence[Sequence[Scalar]], seen: Sequence[Scalar]
) -> tuple[list[Scalar], list[Scalar]]:
    """L⁻¹d with LLᵀ the covariance of the channels seen, zero for masked channels, and the diagonal of L.

    `covariance`: n rows, symmetric positive definite. Its log determinant is twice the sum of the logarithms of the
    diagonal over the channels seen.
    """
    L: list[list[Scalar]] = []
    result: list[Scalar] = []
    for i, (d, saw) in enumerate(zip(differences, seen, strict=True)):
        row: list[Scalar] = []
        for j in range(i):
            remainder = covariance[i][j] - total(row[k] * L[j][k] for k in range(j))
            row.append(jnp.where(seen[j], remainder / L[j][j], 0.0))
        row.append(jnp.sqrt(covariance[i][i] - total(x * x for x in row)))
        L.append(row)
        result.append(jnp.where(saw, (d - total(x * w for x, w in zip(row, result, strict=False))) / row[i], 0.0))
    return result, [row[i] for i, row in enumerate(L)]


class FixSensor(AbstractFixSensor):
    """Fixes with independent errors: standard deviations `sigma_horizontal` m of x and y, `sigma_vertical` m of z."""

    sigma_horizontal: Noise
    sigma_vertical: Noise
    reported_std_scale: Noise
    dof: Noise | None
    latency: Noise
    latency_std: Noise

    def __init__(self, sigma_horizontal: float, sigma_vertical: float, dof: float | None = None, latency: float = 0.0):
        self.sigma_horizontal = Scale(sigma_horizontal, "m", "measurement noise", "horizontal")
        self.sigma_vertical = Scale(sigma_vertical, "m", "measurement noise", "vertical")
        self.reported_std_scale, self.dof = Scale(1.0), None if dof is None else Scale(dof)
        self.latency, self.latency_std = Real(latency, "s", typical=0.5), Considered(0.0, "s")

    def noise(self) -> list[list[Scalar]]:
        horizontal, vertical = self.sigma_horizontal.value**2, self.sigma_vertical.value**2
        return [[horizontal, 0.0, 0.0], [0.0, horizontal, 0.0], [0.0, 0.0, vertical]]


class CorrelatedFixSensor(AbstractFixSensor):
    """Fixes with correlated errors: `covariance` (3, 3) m², for instance of the fixes of a tag at rest."""

    covariance: Noise
    reported_std_scale: Noise
    dof: Noise | None
    latency: Noise
    latency_std: Noise

    def __init__(self, covariance: Any, dof: float | None = None, latency: float = 0.0):
        self.covariance = Covariance(covariance, "m^2", "measurement noise", "all")
        self.reported_std_scale, self.dof = Scale(1.0), None if dof is None else Scale(dof)
        self.latency, self.latency_std = Real(latency, "s", typical=0.5), Considered(0.0, "s")

    def noise(self) -> list[list[Scalar]]:
        return [[self.covariance.value[i, j] for j in range(3)] for i in range(3)]


class FixStart(AbstractStart):
    """A start at the first fix with x and y, at rest, with `sigma_position` m and `sigma_velocity` m/s.

    `planar`: x and y alone. `velocities`, `accelerations`: their numbers of components in the state; accelerations have
    a standard deviation of `sigma_velocity` per second, m/s². Without z the height has a standard deviation of 1 km.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    planar: bool = eqx.field(static=True)
    velocities: int = eqx.field(static=True)
    accelerations: int = eqx.field(static=True, default=0)

    @property
    def readings(self) -> Mapping[str, int]:
        """Fixes with x, y and z."""
        return {FIXES: 3}

    def can_start(self, row: Row) -> Scalar:
        seen = row.readings[FIXES].seen
        return seen[0] & seen[1]

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        reading = row.readings[FIXES]
        x, y, z = (reading.values[k] for k in range(3))
        return jnp.stack([x, y, jnp.where(reading.seen[2], z, 0.0)])

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero = jnp.zeros_like(candidate[0])
        position_variance, velocity_variance = self.sigma_position.value**2, self.sigma_velocity.value**2
        height_variance = jnp.where(row.readings[FIXES].seen[2], position_variance, 1e6)
        variances = [position_variance, position_variance, height_variance][:n]
        position, velocity = Vector(*(candidate[k] for k in range(n))), Vector(*[zero] * self.velocities)
        cov = diagonal([*variances, *[velocity_variance] * (self.velocities + self.accelerations)], zero)
        if self.accelerations:
            return Gaussian(Accelerated(position, velocity, Vector(*[zero] * self.accelerations)), cov)
        return Gaussian(Kinematic(position, velocity), cov)


AXES_M, AXES_STD_M = ([f"{axis}_{what}" for axis in "xyz"] for what in ("m", "std_m"))


def fix_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's fixes, one row per table row; z is masked where the tag's height is known and used."""
    rows = folder.rows("fixes")
    values, seen = rows.values(AXES_M)
    if not free_height:
        seen[:, 2] &= rows.of_each(np.isnan(known_heights(folder, rows.tags)))
    # Zeros where no standard deviations are reported, so that trajectories with and without them share a batch.
    readings = {FIXES: Readings(values, seen, rows.variances(AXES_STD_M))}
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, readings, {})


def lacks_fixes(folder: RecordingFolder) -> str | None:
    """What a folder lacks for a tracker of fixes, in words: the table, or the height of a tag; None if nothing."""
    if "fixes" not in folder.tables:
        return "a fixes table, found no such table"
    lacking = without_height(folder.rig, folder.tables["fixes"])
    return f"z_m of tag {lacking[0]!r} in fixes, or its height_m in rig.toml, found neither" if lacking else None
