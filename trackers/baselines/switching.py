"""IMM trackers of fixes: modes of manoeuvre, and the two sides of the anchors' plane.

Coplanar anchors are at equal ranges from a tag and from its mirror image in their plane, so the z of a fix has an
ambiguous sign about the plane. It measures the distance from the plane only, with a bias and a scale factor that come
from range errors:

    h  height of the plane      d = |z_fix − h|      d = offset + shrink · s · (z − h)      s  +1 above, −1 below

An IMM filter runs one Kalman filter for each side, s = ±1. Near the plane both fit equally well, and after it is
crossed the mode is ambiguous: the mixture's mean lies between the two branches and its covariance includes their
separation. The start of the track and the floor, below which there is no tag, resolve the ambiguity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.errors import require
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.filters.imm import (
    AbstractInteractingModels,
    AbstractSwitching,
    InteractingModels,
    Mixture,
    SwitchingMotion,
)
from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import HEIGHT, Input, Inputs
from trackwright.trackers.core.model.linearise import covariance_of
from trackwright.trackers.core.model.motion import GroundMotion, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Row
from trackwright.trackers.core.model.tunable import Considered, Real, Scale
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import FIXES, PATIENT, AbstractFixSensor, FixSensor, FixStart
from trackwright.trackers.parts.start_nearby import at_rest

BELOW, ABOVE = 0, 1

PLANE = Input(
    "plane",
    (),
    "m",
    "the height of the anchors' plane",
    "`tw.build('fix-mirror', folder)`, from the anchors of a recording folder",
)
"""The input with the height h of the plane."""

FIX_Z = Input(
    "fix_z",
    (),
    "m",
    "z of the fix, or the height of the anchors' plane where z is missing",
    "`tw.build('fix-mirror', folder)`, from the anchors of a recording folder",
)
"""The input with the height of a start."""


class MirrorSensor(AbstractFixSensor, AbstractSwitching):
    """x, y, the distance d from the anchors' plane, and the depth below the floor, a pseudo-measurement of 0, m.

    Modes: a tag `BELOW` or `ABOVE` the plane; below without modes. `offset` m, `shrink`: as in the module's docstring.
    `floor`: height of the floor, m. `give` m: standard deviation of the depth below it; it is not identifiable, since
    the pseudo-measurement is always 0. `sigma_horizontal` and `sigma_vertical` m: standard deviations of x and y, and
    of d. Reported ones, scaled by `reported_std_scale`, add to these in variance; errors follow Student's t of `dof`
    degrees of freedom, None for normal ones. Fixes are measured `latency` s before the row's time. Input: `plane`, h,
    m.
    """

    sigma_horizontal: Noise
    sigma_vertical: Noise
    give: Noise
    offset: Noise
    shrink: Noise
    floor: Noise
    reported_std_scale: Noise
    dof: Noise | None
    latency: Noise
    latency_std: Noise
    side: float

    def __init__(self, sigma_horizontal: float, sigma_vertical: float, offset: float, shrink: float, dof: float | None):
        self.sigma_horizontal = Scale(sigma_horizontal, "m", "measurement noise", "horizontal")
        self.sigma_vertical = Scale(sigma_vertical, "m", "measurement noise", "vertical")
        self.offset, self.shrink = Real(offset, "m", typical=0.1), Scale(shrink)
        self.floor, self.give = Real(0.0, "m"), Scale(0.3, "m")
        self.reported_std_scale, self.dof = Scale(1.0), None if dof is None else Scale(dof)
        self.latency, self.latency_std = Real(0.0, "s", typical=0.5), Considered(0.0, "s")
        self.side = -1.0

    @property
    def inputs(self) -> tuple[Input, ...]:
        return PLANE, HEIGHT

    def in_mode(self, mode: int) -> MirrorSensor:
        return eqx.tree_at(lambda sensor: sensor.side, self, 1.0 if mode == ABOVE else -1.0)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """x, y, distance from the plane, depth below the floor, m."""
        return *super().channels[:2], Channel("off_plane", "m"), Channel("under_floor", "m")

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        x, y, z = super().measure(view, inputs)
        off_plane = self.offset.value + self.shrink.value * self.side * (z - inputs["plane"])
        return [x, y, off_plane, jnp.minimum(z - self.floor.value, 0.0)]

    def noise(self) -> list[list[Scalar]]:
        sigmas = (self.sigma_horizontal, self.sigma_horizontal, self.sigma_vertical, self.give)
        return [[sigma.value**2 if i == j else 0.0 for j in range(4)] for i, sigma in enumerate(sigmas)]


class MirrorModels(AbstractInteractingModels):
    """IMM filter whose modes switch near the anchors' plane only, at `switching_rate`, 1/s, in the plane.

    Away from it the rate is scaled by exp(−(z − h)²/2(P + reach²)) with the height's variance P and `reach` m; mixing
    branches at metres from each other would bias both. Input: `plane`, h, m.
    """

    switching_rate: Noise
    mode_prior: Noise
    filter: ExtendedKalman
    reach: Noise

    def __init__(self, switching_rate: float, mode_prior: Sequence[float], reach: float):
        self.filter = ExtendedKalman()
        self.switching_rate, self.mode_prior = Scale(switching_rate, "1/s"), Scale(np.asarray(mode_prior, float))
        self.reach = Scale(reach, "m")

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (PLANE,)

    def switching_rates(self, belief: Mixture, inputs: Inputs) -> list[Scalar]:
        rates = []
        for mean, cov in belief.components:
            variance = covariance_of(mean, cov, lambda state: state.position)[2, 2] + self.reach.value**2
            rates.append(
                self.switching_rate.value * jnp.exp(-0.5 * (mean.position[2] - inputs["plane"]) ** 2 / variance)
            )
        return rates


class MirrorStart(AbstractStart):
    """A start at the first fix with x and y, at its z, whose side of the plane is thereby favoured; at rest.

    `sigma_position` m, `sigma_velocity` m/s: standard deviations. Input: `fix_z`, m, the z of the row's fix, or the
    plane's height where z is missing.
    """

    sigma_position: Noise
    sigma_velocity: Noise

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (FIX_Z,)

    @property
    def readings(self) -> Mapping[str, int]:
        return {FIXES: 2}

    def can_start(self, row: Row) -> Scalar:
        seen = row.readings[FIXES].seen
        return seen[0] & seen[1]

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        values = row.readings[FIXES].values
        return jnp.stack([values[0], values[1], row.inputs["fix_z"]])

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        return at_rest([candidate[k] for k in range(3)], 2, self.sigma_position, self.sigma_velocity)


def switching_tracker(
    sigmas_a: Sequence[float] = (0.05, 0.5, 5.0),
    sigma_z: float = 0.3,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    rate: float = 1.0,
    dof: float | None = 4.0,
    planar: bool = False,
) -> Tracker:
    """IMM filter of constant-velocity models with accelerations `sigmas_a`, m/s² per √Hz, from fixes.

    `rate`: draws of a new mode, 1/s. `sigma_z` m per √s, the sensor's sigmas m; `dof`: degrees of freedom of Student's
    t, None for normal noise. `planar`: x and y alone.
    """
    several = isinstance(sigmas_a, (Sequence, np.ndarray)) and not isinstance(sigmas_a, str) and len(sigmas_a) > 0
    require(several, "switching_tracker", sigmas_a, "the noise level of each model, as switching_tracker((0.05, 5.0))")
    motion = SwitchingMotion(tuple(GroundMotion(sigma_a, sigma_z) for sigma_a in sigmas_a))
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    modes = InteractingModels(rate, [1.0] * len(sigmas_a))
    return Tracker(motion, {FIXES: sensor}, start, modes, PATIENT, FIXES)


def mirror_tracker(
    sigma_a: float = 0.35,
    sigma_z: float = 1.0,
    sigma_horizontal: float = 0.11,
    sigma_vertical: float = 0.4,
    offset: float = 0.55,
    shrink: float = 0.45,
    rate: float = 1.0,
    dof: float | None = 4.0,
) -> Tracker:
    """Constant velocity in x and y and a random-walk height on either side of the anchors' plane, from fixes.

    `offset` m and `shrink`: as in the module's docstring; the defaults are typical of four DWM1001 anchors in the
    corners of a room. `rate`, 1/s: mode switches in the plane.
    """
    sensor = MirrorSensor(sigma_horizontal, sigma_vertical, offset, shrink, dof)
    start = MirrorStart(Scale(1.0, "m"), Scale(1.0, "m/s"))
    return Tracker(
        GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, MirrorModels(rate, [1.0, 1.0], 0.1), PATIENT, FIXES
    )
