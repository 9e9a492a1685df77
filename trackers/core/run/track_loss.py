"""Track loss: when a tracker gives up a track and starts a new one."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.filters.filter import Innovation
from trackwright.trackers.core.model.algebra import Scalar, total
from trackwright.trackers.core.model.covariance import AnyCovariance, Gaussian, variance
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import Threshold

ROOM = Input(
    "room",
    (4,),
    "m",
    "lowest and highest x, lowest and highest y of a tag",
    "`outline_m` of the rig's floor, or from the positions of anchors or stations",
    Need.IF_GIVEN,
)
"""The input with the horizontal box that a tag cannot leave."""

SIGMAS = 3.0  # standard deviations outside the room at which a track is lost


class AbstractTrackLoss(eqx.Module):
    """The test for track loss, after which a track restarts; sweeps change its thresholds, fits do not.

    `max_gap`: limit of the time without measurements, s; np.inf for none.
    """

    max_gap: eqx.AbstractVar[Threshold]

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that it reads; none by default."""
        return ()

    @abstractmethod
    def initial(self, prior: Gaussian) -> Any:
        """The test statistic of a new track."""

    @abstractmethod
    def after(self, statistic: Any, innovation: Innovation, row: Row, tracker: Any, before: Any) -> Any:
        """The test statistic after a row of a tracker, whose belief was `before` the row."""

    @abstractmethod
    def exceeded(self, statistic: Any) -> Scalar:
        """Whether the statistic is beyond its limit."""


class TrackLossPolicy(AbstractTrackLoss):
    """Track loss by the NIS, for Gaussian noise.

    `nis_limit`: of the running mean of NIS per degree of freedom, over about `nis_window` rows with measurements.
    `max_gap`: as in `AbstractTrackLoss`. np.inf disables a limit.
    """

    nis_limit: Threshold
    nis_window: Threshold
    max_gap: Threshold

    def __init__(self, nis_limit: float = 6.0, nis_window: float = 8.0, max_gap: float = 5.0):
        self.nis_limit, self.nis_window = Threshold(nis_limit), Threshold(nis_window)
        self.max_gap = Threshold(max_gap, "s")

    def initial(self, prior: Gaussian) -> Scalar:
        return jnp.ones_like(prior.cov[0])

    def after(self, statistic: Scalar, innovation: Innovation, row: Row, tracker: Any, before: Any) -> Scalar:
        correction = (innovation.nis / jnp.maximum(innovation.nis_dof, 1.0) - statistic) / self.nis_window.value
        return statistic + jnp.where(innovation.nis_dof > 0, correction, 0.0)

    def exceeded(self, statistic: Scalar) -> Scalar:
        return statistic > self.nis_limit.value


# Evidence, nats, that each reading costs another place, so that one which explains no readings is given up.
PRICE = 0.2

BLUR = 3.0  # factor on the errors of readings at another place, which lags behind a tag that moves
# Least and largest share of wild readings, and the number of readings over which it is estimated.
WILD, READINGS = (0.02, 0.5), 50.0


class Elsewhere(NamedTuple):
    """The evidence that a tag is at another place, nats, the share of wild readings, and that place (3,), m."""

    evidence: Scalar
    wild: Scalar
    place: Any


class TrackScorePolicy(AbstractTrackLoss):
    """Track loss by the evidence for another place, for heavy tails, which bound the NIS, and by the room.

    The other place is where a start in the latest row before would have been. Its evidence is the log-likelihood ratio
    of the readings, with the density 1/`width` on both sides for the share of them that is wild, so that readings which
    agree with neither decide nothing; it sums up from zero (Page's CUSUM test). The share is estimated from the latest
    readings. A place nearer to the track than `away`, m, gains nothing. Beyond `score_limit` nats the track is lost; it
    is also lost where its mean is more than `SIGMAS` standard deviations outside the input `room`. `width`: in the unit
    of the measurements. `max_gap`: as in `AbstractTrackLoss`.
    """

    score_limit: Threshold
    width: Threshold
    max_gap: Threshold
    away: float = eqx.field(static=True)

    def __init__(self, width: float, unit: str, score_limit: float = 8.0, max_gap: float = 10.0, away: float = 0.5):
        self.away = away
        self.score_limit, self.width = Threshold(score_limit), Threshold(width, unit)
        self.max_gap = Threshold(max_gap, "s")

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (ROOM,)

    def initial(self, prior: Gaussian) -> Elsewhere:
        zero = jnp.zeros_like(prior.cov[0])
        return Elsewhere(zero, zero + WILD[1], jnp.stack([*prior.mean.position, zero][:3]))

    def after(self, statistic: Elsewhere, innovation: Innovation, row: Row, tracker: Any, before: Any) -> Elsewhere:
        densities = innovation.log_likelihood, log_density_at(statistic.place, row, tracker)
        here, there = (x + innovation.nis_dof * jnp.log(self.width.value) for x in densities)
        track = tracker.filter.moments(before)[0].position
        away = total((x - y) ** 2 for x, y in zip(track, statistic.place, strict=False)) > self.away**2
        odds = jnp.log(statistic.wild) - jnp.log1p(-statistic.wild)
        gain = jnp.logaddexp(odds, there) - jnp.logaddexp(odds, here)
        gain = jnp.where(away, gain, jnp.minimum(gain, 0.0)) - PRICE
        wild = jax.nn.sigmoid(odds - jnp.maximum(here, there))
        wild = jnp.clip(statistic.wild + (wild - statistic.wild) / READINGS, *WILD)
        evidence = jnp.maximum(statistic.evidence + gain, 0.0)
        seen = innovation.nis_dof > 0
        place = tracker.start.candidate(tracker.sensors, row)
        after = Elsewhere(
            jnp.where(seen, evidence, statistic.evidence),
            jnp.where(seen, wild, statistic.wild),
            jnp.where(tracker.start.can_start(row), place, statistic.place),
        )
        return jax.lax.stop_gradient(after)

    def exceeded(self, statistic: Elsewhere) -> Scalar:
        return statistic.evidence > self.score_limit.value


def log_density_at(place: Any, row: Row, tracker: Any) -> Scalar:
    """The log density of a row's readings, with errors larger by `BLUR`, of a tag that starts at this place (3,), m."""
    view = tracker.motion.view(tracker.start.belief(place, row).mean)
    sensors = tracker.sensors.items()
    residuals = [s.residual(row.readings[name], list(s.measure(view, row.inputs))) for name, s in sensors]
    blurred = (r._replace(whitened=[x / BLUR for x in r.whitened]).log_density for r in residuals)
    return total(x - r.nis_dof * np.log(BLUR) for x, r in zip(blurred, residuals, strict=True))


def outside(mean: Any, cov: AnyCovariance, room: Any) -> Scalar:
    """Whether a position is more than `SIGMAS` standard deviations outside the room (4,) of `ROOM`."""
    first = component_names(mean).index("position.0")
    beyond = []
    for axis in range(2):
        low, high = room[2 * axis], room[2 * axis + 1]
        distance = jnp.maximum(low - mean.position[axis], mean.position[axis] - high)
        beyond.append((distance > 0.0) & (distance * distance > SIGMAS**2 * variance(cov, first + axis)))
    return beyond[0] | beyond[1]
