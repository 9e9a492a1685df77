"""Angles that a calibrated station measures, as a function of the true ones: `recordings/calibration.py` for JAX."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp

from trackwright.trackers.core.model.algebra import Scalar
from trackwright.trackers.core.model.inputs import AnyArray, Input, Need

CALIBRATION = Input(
    "calibration",
    (12,),
    "",
    "offset, gain, cubic and cross term of azimuth and of elevation, and lowest and highest value of each in the fit",
    "`folder.calibrated(calibration)`",
    Need.IF_GIVEN,
)
"""The input with the systematic errors of a row's station."""


def measured_angles(true: Sequence[Scalar], calibration: AnyArray) -> tuple[Scalar, Scalar]:
    """The azimuth and elevation, rad, that a station measures at the true ones; linear beyond the span of the fit."""
    azimuth, elevation = true
    inside = [jnp.clip(a, calibration[8 + 2 * k], calibration[9 + 2 * k]) for k, a in enumerate(true)]

    def measured(k: int, a: Scalar, clipped: Scalar, other: Scalar) -> Scalar:
        offset, gain, cubic, cross = (calibration[4 * k + i] for i in range(4))
        return offset + a * (gain + cross * other) + cubic * clipped * clipped * (3.0 * a - 2.0 * clipped)

    return measured(0, azimuth, inside[0], inside[1]), measured(1, elevation, inside[1], inside[0])
