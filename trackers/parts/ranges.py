"""Ranges to anchors: the sensor that trackers with and without an inertial sensor share.

A row has a fixed number of slots, each a range to any anchor; which anchor, and where it stands, are inputs of the
row. So ranges may come one at a time or together, and recordings of different installations share a tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, total
from trackers.core.motion import Noise
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, log_peak, placed
from trackers.core.state import Heading
from trackers.core.tunable import Real, Scale

RANGES = "ranges"


class RangeSensor(AbstractSensor):
    """Distances, m, from a tag at `view.position` to the anchors of this row's slots (Kwon et al. 2021, equation 29).

    Inputs: `anchors` (3·slots,) m, the anchor's x, y, z of each slot; `anchor` (slots,), its number; `height` m for a
    planar state; optionally `levers` (3·slots,) m, where the slot's tag sits on the body, body axes, for a view with
    an `attitude`. A view with a `bias` (one per anchor, m) has it added.

    Ranges are too long much more often than too short: Student's t with `dof` degrees of freedom, in two pieces, of
    scale `sigma_r` m for what is too short and `positive_skew`·`sigma_r` for what is too long. `bias`: m per anchor number.
    What a device reports of a slot's noise is its variance, m², added to that of `sigma_r`.
    """

    sigma_r: Noise
    positive_skew: Noise
    dof: Noise
    bias: Noise
    slots: int = eqx.field(static=True)

    def __init__(self, slots: int, anchors: int, sigma_r: float, positive_skew: float, dof: float, bias: float = 0.0):
        """`slots`: ranges a row; `anchors`: how many biases there are; `bias`: what each of them is at first."""
        self.slots = slots
        self.sigma_r = Scale(sigma_r, "m")
        self.positive_skew = Scale(positive_skew)
        self.dof = Scale(dof)
        self.bias = Real(np.full(anchors, bias), "m", typical=0.1)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One range per slot."""
        return tuple(Channel(f"range_{k + 1}", "m") for k in range(self.slots))

    def measure(self, view: Any, inputs: Any) -> list[Scalar]:
        position = placed(view.position, inputs)
        ranges = []
        for slot in range(self.slots):
            tag = position
            if "levers" in inputs and hasattr(view, "attitude"):
                lever = Vector.of(inputs["levers"][3 * slot + k] for k in range(3))
                tag = position + in_room_axes(view.attitude, lever)
            anchor = Vector.of(inputs["anchors"][3 * slot + k] for k in range(3))
            number = inputs["anchor"][slot]
            bias = of_number(self.bias.value, number)
            if hasattr(view, "bias"):
                bias = bias + of_number(view.bias, number)
            ranges.append((tag - anchor).norm() + bias)
        return ranges

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Each slot's difference over the scale of its sign; the two pieces of the density meet at its peak."""
        positive_skew, dof = self.positive_skew.value, self.dof.value
        variances = reading.reported if len(reading.reported) else [0.0] * self.slots
        whitened, log_scales = [], []
        for z, p, seen, variance in zip(reading.values, predicted, reading.seen, variances, strict=True):
            sigma = jnp.sqrt(self.sigma_r.value**2 + variance)
            whitened.append(jnp.where(seen, (z - p) / jnp.where(z > p, sigma * positive_skew, sigma), 0.0))
            peak = log_peak(dof) - jnp.log(sigma) - jnp.log(0.5 * (1.0 + positive_skew))
            log_scales.append(jnp.where(seen, peak, 0.0))
        nis_dof = total(jnp.where(seen, jnp.ones_like(whitened[0]), 0.0) for seen in reading.seen)
        return Residual(whitened, total(log_scales), nis_dof, dof=dof)


def in_room_axes(attitude: Any, vector: Vector) -> Vector:
    """A body vector in the room's axes, by a `Rotation`, or by a `Heading` about the vertical."""
    if isinstance(attitude, Heading):
        cosine, sine = jnp.cos(attitude.angle), jnp.sin(attitude.angle)
        x, y, z = vector
        return Vector(cosine * x - sine * y, sine * x + cosine * y, z)
    rotated: Vector = attitude.apply(vector)
    return rotated


def of_number(values: Any, number: Scalar) -> Scalar:
    """The entry of `values` with this number, 0 beyond them: a sum of selections, which batches like arithmetic."""
    count = len(values) if isinstance(values, Vector) else np.shape(values)[0]
    return total(jnp.where(number == k, values[k], 0.0) for k in range(count))
