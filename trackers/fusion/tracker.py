"""One tracker of the sensors of several: position, velocity, and the biases of each kind of readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx

from trackwright.trackers.core.model.algebra import Scalar, Vector, diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import (
    BiasDrift,
    BiasedStart,
    DriftingBiases,
    damped,
    drifted,
    in_turn,
    norm_of,
    shrunk_speed,
)
from trackwright.trackers.parts.ranges import with_delay
from trackwright.trackers.parts.start_nearby import AbstractNearbyStart
from trackwright.trackers.uwb_imu.fusion import REACH

START_STD = 1.5  # standard deviation, m, of the position at a start, as of `bearings`


class FusedState(NamedTuple):
    """As `BiasedState`, with the biases of each kind of readings by its name; `shared`: of ranges."""

    position: Vector
    velocity: Vector
    bias: dict[str, Vector]
    shared: Vector = Vector()


class FusedMotion(AbstractMotion):
    """The motion of `DriftingBiases` with the biases of several kinds of readings, each with its own levels.

    `sigma_a`, `sigma_z`: white acceleration, horizontal and vertical, m/s² per √Hz; `memory`: time constant of the
    velocities, s.
    """

    sigma_a: Noise
    sigma_z: Noise
    memory: Noise
    drifts: dict[str, BiasDrift]
    speed: Any = None

    @property
    def noise_dimension(self) -> int:
        return 6 + sum(drift.biases for drift in self.drifts.values())

    def at(self, belief: Gaussian) -> FusedMotion:
        """As `DriftingBiases.at`."""
        return eqx.tree_at(lambda motion: motion.speed, self, shrunk_speed(belief), is_leaf=lambda x: x is None)

    def step(self, state: FusedState, inputs: Inputs, dt: Scalar, w: Vector) -> FusedState:
        position, velocity = damped(self, state, dt, w)
        speed = norm_of(state.velocity) if self.speed is None else self.speed
        biases, first = dict[str, Vector](), 6
        for kind, drift in sorted(self.drifts.items()):
            biases[kind] = drifted(drift, state.bias[kind], dt, speed, w.parts[first : first + drift.biases])
            first += drift.biases
        return FusedState(position, velocity, biases, state.shared)


class FusedStart(AbstractNearbyStart):
    """A start at the position in the input `nearby` (4,), at rest, with zero biases.

    `sigma_position` m, `sigma_velocity` m/s, `sigma_bias` of each kind of readings (`ranges` m, `tdoa` m, `bearings`
    rad), and `sigma_shared`, m, of ranges: standard deviations. `biases`: the number of each kind's, in the order of
    their names.
    """

    sigma_position: Noise
    sigma_velocity: Noise
    sigma_bias: dict[str, Noise]
    sigma_shared: Noise | None
    biases: tuple[int, ...] = eqx.field(static=True)
    planar: bool = eqx.field(static=True)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        n = 2 if self.planar else 3
        zero = candidate[0] * 0.0
        counts = dict(zip(sorted(self.sigma_bias), self.biases, strict=True))
        of_biases = [in_turn(self.sigma_bias[kind].value, k) ** 2 for kind in counts for k in range(counts[kind])]
        shared = [] if self.sigma_shared is None else [self.sigma_shared.value**2]
        in_place, moving = self.sigma_position.value**2, self.sigma_velocity.value**2
        state = FusedState(
            Vector(*(candidate[k] for k in range(n))),
            Vector(*[zero] * n),
            {kind: Vector(*[zero] * count) for kind, count in counts.items()},
            Vector(*[zero] * len(shared)),
        )
        return Gaussian(state, diagonal([in_place] * n + [moving] * n + of_biases + shared, zero))


def fused_tracker(trackers: Mapping[str, Tracker], planar: bool = False) -> Tracker:
    """The tracker of all readings of several trackers, which are given by the names of their readings.

    The levels of the motion come from the first whose motion has biases. Every kind keeps its sensor, its biases
    and their levels. `planar`: at a known height.
    """
    motions = {name: t.motion for name, t in trackers.items() if isinstance(t.motion, DriftingBiases)}
    starts = {name: t.start for name, t in sorted(trackers.items()) if isinstance(t.start, BiasedStart)}
    levels = next(iter(motions.values()))
    drifts = {
        name: BiasDrift(motion.sigma_bias, motion.time_constant, motion.length, motion.biases)
        for name, motion in sorted(motions.items())
        if motion.biases
    }
    # Times of one kind are what the others are late against; fixes have a latency of their own.
    others = [name for name, tracker in trackers.items() if hasattr(tracker.sensors[name], "late")][1:]
    delayed = {name: with_delay(trackers[name].sensors[name]) for name in others}
    start = FusedStart(
        Scale(START_STD, "m"),
        Scale(1.0, "m/s"),
        {name: starts[name].sigma_bias for name in drifts},
        next((start.sigma_shared for start in starts.values() if start.sigma_shared is not None), None),
        tuple(drift.biases for drift in drifts.values()),
        planar,
    )
    return Tracker(
        FusedMotion(levels.sigma_a, levels.sigma_z, levels.memory, drifts),
        {name: tracker.sensors[name] for name, tracker in trackers.items()} | delayed,
        start,
        track_loss=TrackScorePolicy(REACH, "m"),
        lasting_errors=any(tracker.lasting_errors for tracker in trackers.values()),
    )
