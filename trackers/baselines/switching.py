"""Trackers of fixes that hesitate between models: how hard the tag manoeuvres, and on which side of a plane it is.

Anchors in one plane see a tag and its mirror image in that plane at the same distances, so that a locating system
takes one height for the other. What its z does tell is the distance from the plane, and not even that well: range
errors push it away from the plane and shrink it.

    h  height of the plane      d = |z_fix − h|      d = offset + shrink · s · (z − h)      s  +1 above, −1 below

Two Kalman filters, s = ±1, run side by side; they meet near the plane, where d says little, and part again without
anybody knowing which is right. Then the mixture's mean lies between them and its covariance says so. What tells them
apart is where the track began, and that nothing is under the floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from trackers.core.algebra import Scalar, full
from trackers.core.imm import AbstractSwitching, InteractingModels, Mixture, SwitchingMotion
from trackers.core.motion import GroundMotion, Noise
from trackers.core.recording import Row
from trackers.core.sensor import AbstractSensor, Channel
from trackers.core.state import dimension
from trackers.core.tunable import Real, Scale
from trackers.parts.fixes import FIXES, PATIENT, AbstractFixSensor, FixSensor, FixStart, FixTracker

BELOW, ABOVE = 0, 1


class SideSensor(AbstractFixSensor, AbstractSwitching):
    """x, y, the distance d from the anchors' plane, and how far under the floor, always read as 0, m.

    One mode for a tag `BELOW` the plane, one for `ABOVE`; without modes it is below. `offset` m, `shrink`: as in the
    module's head. `floor`: its height, m; `give` m: how far under it a height may be, which no reading tells
    (the floor is always read as 0, so that a likelihood would make it nothing). Input: `plane`, h, m.
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
    side: float

    def __init__(self, sigma_horizontal: float, sigma_vertical: float, offset: float, shrink: float, dof: float | None):
        self.sigma_horizontal, self.sigma_vertical = Scale(sigma_horizontal, "m"), Scale(sigma_vertical, "m")
        self.offset, self.shrink = Real(offset, "m", typical=0.1), Scale(shrink)
        self.floor, self.give = Real(0.0, "m"), Scale(0.3, "m")
        self.reported_std_scale, self.dof = Scale(1.0), None if dof is None else Scale(dof)
        self.latency = Real(0.0, "s", typical=0.5)
        self.side = -1.0

    def in_mode(self, mode: int) -> SideSensor:
        return eqx.tree_at(lambda sensor: sensor.side, self, 1.0 if mode == ABOVE else -1.0)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """x, y, distance from the plane, depth under the floor."""
        return *super().channels[:2], Channel("off_plane", "m"), Channel("under_floor", "m")

    def measure(self, view: Any, inputs: Any) -> list[Scalar]:
        x, y, z = super().measure(view, inputs)
        off_plane = self.offset.value + self.shrink.value * self.side * (z - inputs["plane"])
        return [x, y, off_plane, jnp.minimum(z - self.floor.value, 0.0)]

    def noise(self) -> list[list[Scalar]]:
        sigmas = (self.sigma_horizontal, self.sigma_horizontal, self.sigma_vertical, self.give)
        return [[sigma.value**2 if i == j else 0.0 for j in range(4)] for i, sigma in enumerate(sigmas)]


class SideModels(InteractingModels):
    """Modes that a tag changes only where it may be in the anchors' plane: `switching_rate`, 1/s, is that of a tag inside it.

    Far from the plane the rate is that share of it which the height leaves to the plane, exp(−(z − h)²/2(P + reach²)):
    mixing branches metres apart would drag each of them towards the other. Input: `plane`, h, m.
    """

    reach: Noise

    def __init__(self, switching_rate: float, mode_prior: Sequence[float], reach: float):
        super().__init__(switching_rate, mode_prior)
        self.reach = Scale(reach, "m")

    def rates(self, belief: Mixture, inputs: Any) -> list[Scalar]:
        rates = []
        for mean, cov in belief.components:
            spread = full(cov, dimension(mean))[2][2] + self.reach.value**2
            rates.append(self.switching_rate.value * jnp.exp(-0.5 * (mean.position[2] - inputs["plane"]) ** 2 / spread))
        return rates


class ShownStart(FixStart):
    """The first fix with x and y, at the height that it showed: a hint at the side, as weak as `sigma_position`.

    Input: `shown`, m, the z of the row's fix, or the plane's height where it had none.
    """

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        values, shown = row.readings[FIXES].values, row.inputs["shown"]
        return jnp.stack([values[0], values[1], shown, jnp.ones_like(shown)])


def switching_tracker(
    sigmas_a: Sequence[float] = (0.05, 0.5, 5.0),
    sigma_z: float = 0.3,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.3,
    rate: float = 1.0,
    dof: float | None = 4.0,
    planar: bool = False,
) -> FixTracker:
    """Interacting constant-velocity models with accelerations of σa m/s² per √Hz, drawn anew at `rate` 1/s."""
    motion = SwitchingMotion(tuple(GroundMotion(sigma_a, sigma_z) for sigma_a in sigmas_a))
    sensor = FixSensor(sigma_horizontal, sigma_vertical, dof)
    start = FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), planar, 2)
    modes = InteractingModels(rate, [1.0] * len(sigmas_a))
    return FixTracker(motion, {FIXES: sensor}, start, modes, PATIENT)


def mirror_tracker(
    sigma_a: float = 1.0,
    sigma_z: float = 1.0,
    sigma_horizontal: float = 0.1,
    sigma_vertical: float = 0.4,
    offset: float = 0.55,
    shrink: float = 0.45,
    rate: float = 1.0,
    dof: float | None = 4.0,
) -> FixTracker:
    """Constant velocity over the floor and a drifting height on either side of the anchors' plane, from fixes.

    `offset` m and `shrink` as in the module's head: about what four DWM1001 anchors in the corners of a room show.
    `rate`, 1/s: how soon it is forgotten on which side the tag was.
    """
    sensor = SideSensor(sigma_horizontal, sigma_vertical, offset, shrink, dof)
    start = ShownStart(Scale(1.0, "m"), Scale(1.0, "m/s"), False, 2)
    return FixTracker(
        GroundMotion(sigma_a, sigma_z), {FIXES: sensor}, start, SideModels(rate, [1.0, 1.0], 0.1), PATIENT
    )
