"""Smoothed trackers: estimates given later measurements too, of the whole recording or of a fixed lag."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import jax
import jax.numpy as jnp

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import UnusableInput, require
from trackwright.trackers.core.filters.filter import AbstractSmoothableFilter
from trackwright.trackers.core.filters.rts import fixed_interval, fixed_lag, in_scalars
from trackwright.trackers.core.model.algebra import Scalar, triangle
from trackwright.trackers.core.model.covariance import Gaussian, by_entry, few, size_of, variance
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.tunable import freeze
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output, moments_by_entry, scan_rows
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker, AbstractTracker, Tracker


class Smoothed(AbstractEpochwiseTracker):
    """A tracker with an RTS smoother; log-likelihood, NIS and status remain the filter's.

    `lag`: fixed-lag smoothing with measurements up to `lag` s later; None for fixed-interval smoothing. The recursion
    does not cross a restart of the track, nor the end of a run that another continues. With `Tracker.lasting_errors`
    the covariances are `bounded`, larger than the model's. Raises TypeError unless the filter is an
    `AbstractSmoothableFilter`.
    """

    tracker: Tracker
    lag: float | None = None

    def __check_init__(self) -> None:
        require(
            isinstance(self.tracker, AbstractTracker), "Smoothed", self.tracker, "a tracker, as Smoothed(fix_tracker())"
        )
        lag = self.lag if isinstance(self.lag, float | int) else None  # not where it is traced
        if lag is not None and not 0 < lag < 1e6:
            raise UnusableInput(f"lag {lag}: expected seconds above zero; leave it out to use the whole recording")
        if not (isinstance(self.tracker, Tracker) and isinstance(self.tracker.filter, AbstractSmoothableFilter)):
            raise TypeError("Kalman filters and their mixtures have a smoother; chains, particles and grids have none")

    def check_layout(self, layout: Layout) -> None:
        self.tracker.check_layout(layout)

    def for_positions(self) -> Self:
        return replace(self, tracker=self.tracker.for_positions())

    @property
    def nis_sensors(self) -> tuple[AbstractSensor, ...]:
        return self.tracker.nis_sensors

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        tracker = freeze(self.tracker)
        filter_ = tracker.filter
        assert isinstance(filter_, AbstractSmoothableFilter)
        _, output, state = scan_rows(tracker, batch, initial, moments=lambda belief: (belief, ()))
        filtered = output.mean
        usable = (output.status == Status.OK) | (output.status == Status.RESTARTED)
        # Padding, which drawn trajectories have within, keeps the belief of the row before, and no time passes in it.
        padding = output.status == Status.PADDING
        latest = jax.lax.cummax(jnp.where(padding, 0, jnp.arange(len(padding), dtype=jnp.int32)[:, None]))
        runs = jnp.take_along_axis(usable, latest, axis=0)[:-1]
        connected = runs & (padding[1:] | (output.status[1:] == Status.OK))
        elapsed = jnp.where(jnp.asarray(batch.valid), batch.dt, 0.0)
        dt, inputs = jax.tree_util.tree_map(lambda x: jnp.asarray(x)[1:], (elapsed, batch.inputs))

        def gain_of(belief: Any, connected: Scalar, dt: Scalar, inputs: Inputs) -> Any:
            return filter_.rts_gain(belief, tracker.motion, connected, dt, inputs)

        moments = jax.vmap(lambda belief: moments_by_entry(tracker, belief), in_axes=-1, out_axes=-1)

        def estimate_of(beliefs: Any) -> Any:
            return moments(beliefs if few(batch.size) else in_scalars(beliefs))

        if self.lag is None:
            padded = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:1])])  # noqa: E731
            to_next = jax.tree_util.tree_map(padded, (connected, dt, inputs))
            mean, cov = fixed_interval(gain_of, filter_.rts_step, estimate_of, filtered, *to_next)
        else:
            but_last, end = (jax.tree_util.tree_map(lambda x, k=k: x[k], filtered) for k in (slice(-1), -1))
            lag, steps = jnp.asarray(self.lag, batch.dt.dtype), (but_last, connected, dt, inputs)
            smoothed = jax.vmap(estimate_of)(fixed_lag(gain_of, filter_.rts_step, filtered, steps, dt, lag))
            mean, cov = jax.tree_util.tree_map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, moments(end))
        cov = by_entry(cov)
        if self.tracker.lasting_errors:
            cov = bounded(cov, by_entry(jax.vmap(moments)(filtered)[1]))
        return tracker.with_age(output._replace(mean=mean, cov=cov)), state

    def begin(self, prior: Gaussian, batch: Batch) -> Any:
        return self.tracker.begin(prior, batch)


def bounded(smoothed: tuple[jax.Array, ...], filtered: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    """Smoothed covariances, entries (T, B), for errors that earlier and later readings may share to any degree.

    A smoothed component has the variance Pˢ = a + b, with a from the filter's error and b from the later readings. The
    model takes the two errors for independent; whatever their correlation, the variance is at most (√a + √b)² =
    Pˢ + 2√(ab) (Cauchy–Schwarz). Since a ≥ Pˢ²/P, with P the filtered variance, the bound is 2Pˢ where P ≥ 2Pˢ, which
    is covariance intersection with equal weights (Julier and Uhlmann 1997), and falls to Pˢ where later readings add
    nothing. Correlations of components stay as the model has them.
    """
    n = size_of(smoothed)
    factors = [_factor(variance(smoothed, k), variance(filtered, k)) for k in range(n)]
    return tuple(entry * factors[i] * factors[j] for entry, (i, j) in zip(smoothed, triangle(n), strict=True))


def _factor(smoothed: Scalar, filtered: Scalar) -> Scalar:
    """The factor on the standard deviation of a component with these variances."""
    from_later = jnp.clip(1.0 - smoothed / jnp.where(filtered > 0, filtered, 1.0), 0.0, 0.5)
    shared = jnp.where(filtered > 0, from_later * (1.0 - from_later), 0.0)
    # The square root has no derivative at zero.
    some = shared > 0
    return jnp.sqrt(1.0 + 2.0 * jnp.where(some, jnp.sqrt(jnp.where(some, shared, 1.0)), 0.0))
