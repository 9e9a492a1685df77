"""The assembled trackers of a tag on a known path, by particles or on a grid, with any sensors of position or fixes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from trackwright.trackers.core.errors import require
from trackwright.trackers.core.filters.filter import AbstractStart, Innovation
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.algebra import Scalar, diagonal, total
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import Noise, as_scale
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Reading, Residual, Row, independent
from trackwright.trackers.core.model.tunable import Scale, Threshold
from trackwright.trackers.core.run.track_loss import AbstractTrackLoss
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.line.grid import GridFilter
from trackwright.trackers.line.motion import (
    HaltingMotion,
    HaltingState,
    LineMotion,
    PathOutputMap,
    PathState,
    floor_state,
)

SIGMA_A = 0.05  # change of speed, m/s per √s: a cart at walking pace whose speed may differ between segments

SIGMA_LINE = 0.02  # standard deviation of a marked path, m
# Of a tag that may halt anywhere: change of speed, m/s per √s, and mean times of travel and of rest, s.
STEADY, TRAVEL, REST = 0.03, 20.0, 10.0

CURVE_SPACING = 0.5  # mean distance between knots, m, below which they are treated as points on a curve

MOST_CELLS = 2**16  # cells of the longest path of a grid filter, 3 km of 5 cm: with 64 speeds, 17 MB for each tag
# Points along the path at which a row's density is evaluated: at least, at most m apart, and at most.
POINTS, CLOSE, MOST_POINTS = 201, 0.5, 4097

FLOOR = 10.0  # nats below its maximum to which the density of a row falls where the test for track loss compares it


def log_densities(
    line: Polyline, points: int, sensors: Mapping[str, AbstractSensor], row: Row
) -> tuple[jax.Array, jax.Array, Scalar]:
    """Arclengths (points,), the log densities of a row's readings for a tag there, and the log density at its peak."""
    along = jnp.arange(points, dtype=row.dt.dtype) * (line.length / (points - 1))

    def at(arclength: Scalar) -> tuple[Scalar, Scalar]:
        view = floor_state(line, PathState(arclength, 0.0 * arclength))
        residuals = [s.residual(row.readings[n], list(s.measure(view, row.inputs))) for n, s in sensors.items()]
        return total(r.log_density for r in residuals), total(r.log_scale for r in residuals)

    densities, peaks = jax.vmap(at)(along)
    return along, densities, peaks[0]


class LineStart(AbstractStart):
    """Prior of arclength, updated with the first measurements, and of speed.

    Prior: half its mass at the first knot, the other half a half-normal along the path with a scale of half its length;
    uniform on a closed path. The variance of the posterior is increased by `sigma_start`² m², since the first
    measurement may be an outlier. The speed is normal about 0 with `sigma_speed` m/s, its negative half clipped to 0;
    with `resting` the tag is at rest.
    """

    line: Polyline
    sigma_start: Noise
    sigma_speed: Noise
    resting: bool = eqx.field(static=True)
    points: int = eqx.field(static=True, default=POINTS)

    smooth: ClassVar[bool] = True
    searches: ClassVar[bool] = True

    def can_start(self, row: Row) -> Scalar:
        seen = [jnp.any(reading.seen) for reading in row.readings.values()]
        return jnp.any(jnp.stack(seen))

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        along, densities, _ = log_densities(self.line, self.points, sensors, row)
        prior = jnp.exp(-2.0 * (along / self.line.length) ** 2)
        # On a closed path the first point is the last one.
        prior = jnp.ones_like(along).at[0].set(0.0) if self.line.closed else prior.at[0].set(jnp.sum(prior))

        # The derivative of a largest number is NaN where a fusion computes it anew with other roundings.
        weights = jnp.exp(densities - jax.lax.stop_gradient(jnp.max(densities))) * prior
        weights = weights / jnp.sum(weights)
        along = self.line.gathered(along, weights)
        mean = jnp.sum(weights * along)
        return jnp.stack([mean, jnp.sum(weights * (along - mean) ** 2)])

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        arclength, zero = candidate[0], jnp.zeros_like(candidate[0])
        start, speed = candidate[1] + self.sigma_start.value**2, self.sigma_speed.value**2
        if self.resting:
            return Gaussian(HaltingState(arclength, zero, zero + 1.0), diagonal([start, 0.0, 0.0], zero))
        return Gaussian(PathState(arclength, zero), diagonal([start, speed], zero))


class ElsewherePolicy(AbstractTrackLoss):
    """Track loss where readings agree with a tag elsewhere on the path: one carried by hand, or a start gone wrong.

    The log-likelihood ratio of a tag anywhere on the path against the track is summed over rows from zero on (Page's
    CUSUM); beyond `score_limit` nats the track is lost. A density counts as at least e^−`FLOOR` of its peak: a reading
    that no place explains says nothing, and no single reading enough. A new track, which rests on one reading, begins
    at three quarters of the limit. On a known path a gap is no track loss; see also `leaving.py`.
    """

    score_limit: Threshold
    max_gap: Threshold
    points: int = eqx.field(static=True)

    def __init__(self, points: int, score_limit: float = 40.0):
        self.score_limit, self.max_gap, self.points = Threshold(score_limit), Threshold(np.inf, "s"), points

    def initial(self, prior: Gaussian) -> Scalar:
        return jnp.full_like(prior.cov[0], 0.75)

    def after(self, statistic: Scalar, innovation: Innovation, row: Row, tracker: Any, before: Any) -> Scalar:
        _, densities, peak = log_densities(tracker.motion.line, self.points, tracker.sensors, row)
        anywhere = jnp.maximum(logsumexp(densities) - np.log(self.points), peak - FLOOR)
        ratio = jax.lax.stop_gradient(anywhere - jnp.maximum(innovation.log_likelihood, peak - FLOOR))
        return jnp.maximum(statistic + ratio / self.score_limit.value, 0.0)

    def exceeded(self, statistic: Scalar) -> Scalar:
        return statistic > 1.0


def line_motion(line: Polyline, sigma_a: float = SIGMA_A, anywhere: bool = False) -> LineMotion | HaltingMotion:
    """`HaltingMotion`; `LineMotion` for a path without joins, or with knots that draw a curve; `sigma_a` m/s per √s.

    With `anywhere` the tag may halt away from joins, too, and on a path without any, with the levels `STEADY`, `TRAVEL`
    and `REST`.
    """
    if line.length < CURVE_SPACING * len(line.lengths) or not (len(line.joins) or anywhere):
        return LineMotion(line, sigma_a)
    return HaltingMotion(line, STEADY, rest=REST, travel=TRAVEL) if anywhere else HaltingMotion(line, sigma_a)


def line_tracker(
    motion: LineMotion | HaltingMotion, sensors: Mapping[str, AbstractSensor], n_particles: int = 1000
) -> Tracker:
    """Particle filter of arclength and speed on a known path (thesis, 2.2); estimates are position and velocity."""
    _require_path("line_tracker", motion)
    return _tracker(motion, sensors, ParticleFilter(n_particles, output_map=_output_map(motion)))


def line_grid_tracker(
    motion: LineMotion | HaltingMotion,
    sensors: Mapping[str, AbstractSensor],
    spacing: float = 0.05,
    fastest: float = 1.5,
    speeds: int = 64,
) -> Tracker:
    """Grid filter of arclength and speed: at least 81 cells of at most `spacing` m, `speeds` up to `fastest` m/s."""
    _require_path("line_grid_tracker", motion)
    cells = max(81, int(np.ceil(float(motion.line.length) / spacing)) + 1)
    require(
        cells <= MOST_CELLS,
        "line_grid_tracker: cells of the path",
        cells,
        f"at most {MOST_CELLS}, as with a greater spacing; a particle filter (line-pf) needs no grid",
    )
    grid = GridFilter(_output_map(motion), cells, speeds, fastest)
    return _tracker(motion, sensors, grid)


def _require_path(function: str, motion: Any) -> None:
    """Refuse anything but a motion along a path as the motion of a tracker's constructor."""
    fits = isinstance(motion, (LineMotion, HaltingMotion))
    require(fits, function, motion, f"a motion along a path, as {function}(line_motion(Polyline(knots)), sensors)")


def _tracker(motion: LineMotion | HaltingMotion, sensors: Mapping[str, AbstractSensor], filter: Any) -> Tracker:
    points = int(np.clip(np.ceil(float(motion.line.length) / CLOSE) + 1, POINTS, MOST_POINTS))
    resting = isinstance(motion, HaltingMotion)
    start = LineStart(motion.line, Scale(0.5, "m"), Scale(0.1, "m/s"), resting, points)
    return Tracker(motion, sensors, start, filter, ElsewherePolicy(points))


def _output_map(motion: LineMotion | HaltingMotion) -> PathOutputMap:
    return PathOutputMap(motion.line, Scale(SIGMA_LINE, "m"))


class FloorFixes(AbstractSensor):
    """x and y of a fix, m, with independent errors of scale `sigma_p` m: Student's t, for `dof` None normal (1.25).

    Reported variances of x and y, m², add to the variance of `sigma_p`.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    sigma_p: Noise
    dof: Noise | None

    def __init__(self, sigma_p: float | Noise, dof: float | None = 4.0):
        self.sigma_p = as_scale(sigma_p, "m", "measurement noise", "horizontal")
        self.dof = None if dof is None else Scale(dof)

    @property
    def channels(self) -> tuple[Channel, ...]:
        return Channel("x", "m"), Channel("y", "m")

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The variances of x and y, m²."""
        return Channel("variance_x", "m^2"), Channel("variance_y", "m^2")

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        return list(view.position)[:2]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        variances = reading.reported if len(reading.reported) else [0.0, 0.0]
        sigmas = [(self.sigma_p.value**2 + v) ** 0.5 for v in variances]
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        return independent(differences, sigmas, reading.seen, None if self.dof is None else self.dof.value)
