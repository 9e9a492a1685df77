"""Planar position fixes, the measurement model of the thesis (1.24)–(1.27)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import Noise, as_scale
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Reading, Residual, independent
from trackwright.trackers.core.model.tunable import Scale

FIXES = "fixes"


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
