"""The assembled trackers of ranges and of range differences (TDoA) without an IMU, with a bias per anchor.

A row of differences is a message: those that a tag reports at one time, in slots. A difference has the errors of two
times of arrival, and errors of differences with a common anchor are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from trackwright.trackers.core.errors import is_count, require
from trackwright.trackers.core.model.algebra import Scalar, Vector
from trackwright.trackers.core.model.inputs import HEIGHT, Input, Inputs
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.sensor import (
    AbstractSensor,
    Channel,
    Reading,
    Residual,
    delayed_position,
    rounding_variance,
)
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.track_loss import TrackScorePolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.drifting_biases import BiasedStart, DriftingBiases
from trackwright.trackers.parts.fixes import correlated
from trackwright.trackers.parts.ranges import RANGES, RangeSensor, bias_in

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration

MAX_BIASES = 16
"""Largest number of anchors with a bias each in the state; the cost of an epoch grows with its square."""

REACH = 25.0  # width, m, of the uniform distribution of a range that does not depend on the track


def range_tracker(
    anchors: int,
    planar: bool = False,
    sigma_a: float = 0.44,
    sigma_z: float = 0.7,
    memory: float = 5.5,
    sigma_r: float = 0.09,
    positive_skew: float = 4.0,
    dof: float = 1.8,
    bias: float = 0.07,
    sigma_bias: float = 0.085,
    time_constant: float = 65.0,
    length: float = 5.0,
    sigma_shared: float = 0.1,
) -> Tracker:
    """Position and velocity from ranges to numbered anchors, one range per row; `planar`: at a known height.

    Motion numbers as in `DriftingBiases`, sensor numbers as in `RangeSensor`; `bias`: mean of the range biases, m;
    `sigma_shared`: standard deviation, m, of the bias of the tag, which its ranges to all anchors share. One set
    of defaults serves hand-held tags, drones, trolleys and tags on the floor; `range_levels` has the defaults of a
    calibrated site. Above `MAX_BIASES` anchors the state has only the shared bias; the tunable ones of the sensor
    remain.
    """
    require(is_count(anchors), "range_tracker", anchors, "the number of anchors, as range_tracker(len(rig.anchors))")
    biases = anchors if anchors <= MAX_BIASES else 0
    return Tracker(
        DriftingBiases(biases, sigma_a, sigma_z, memory, sigma_bias, time_constant, length),
        {RANGES: RangeSensor(1, anchors, sigma_r, positive_skew, dof, bias)},
        BiasedStart(
            Scale(1.0, "m"), Scale(1.0, "m/s"), Scale(sigma_bias, "m"), planar, biases, Scale(sigma_shared, "m")
        ),
        track_loss=TrackScorePolicy(REACH, "m"),
    )


LASTING = MappingProxyType({"time_constant": 5.0, "length": 1.5})
"""How long biases last that a calibration leaves, s and m, as errors of ranges against truth do (docs/decisions.md)."""


def range_levels(calibration: Calibration | None) -> dict[str, float]:
    """The noise levels of `range_tracker`, by name, at a site with this calibration; none where it has no anchors.

    The biases left by a calibration vary from place to place, with its `range_spread` as standard deviation.
    """
    if calibration is None or not calibration.anchors:
        return {}
    return {
        "bias": 0.0,
        "sigma_bias": calibration.range_spread or 0.07,
        **LASTING,
        "sigma_shared": 0.005,
        "sigma_r": 0.06,
        "positive_skew": 3.5,
        "dof": 2.0,
    }


TDOA = "tdoa"

_FROM = "`tw.build('tdoa', folder)`, from the table tdoa of a recording folder"
PAIRS = Input("pairs", (6,), "m", "x, y, z of both anchors of each slot", _FROM, per_channel=True)
PAIR = Input("pair", (2,), "", "the numbers of both anchors of each slot, from 0", _FROM, per_channel=True)
"""The inputs with positions and numbers of the anchors of each difference."""


class RangeDifferenceSensor(AbstractSensor):
    """Distances, m, from a tag at `view.position` to an anchor, less those to another, in the slots of a message.

    Inputs: `pairs` (6·slots,) m, x, y, z of both anchors of each slot; `pair` (2·slots,), their numbers; `height` m for
    a planar state. The prediction includes the difference of both anchors' `view.bias`, m, where a view has it.

    Noise is Student's t with `dof` degrees of freedom and scale `sigma_d` m. Reported are a variance, m², of each slot,
    which adds to `sigma_d` squared, and the correlation of each pair of slots, row by row of the upper triangle, by
    which the differences are whitened. `late`: by how many seconds the times of differences are later than of the
    other readings at the same position.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    sigma_d: Noise
    dof: Noise
    slots: int = eqx.field(static=True)
    late: Noise | None

    def __init__(self, slots: int, sigma_d: float, dof: float):
        """`slots`: differences per row."""
        self.slots = slots
        self.sigma_d = Scale(sigma_d, "m", "measurement noise")
        self.dof = Scale(dof)
        self.late = None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One range difference per slot, m."""
        return tuple(Channel(f"range_difference_{k + 1}", "m") for k in range(self.slots))

    @property
    def inputs(self) -> tuple[Input, ...]:
        return PAIRS, PAIR, HEIGHT

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The variance of each slot, m², and the correlation of each pair of slots."""
        variances = (Channel(f"variance_{k + 1}", "m^2") for k in range(self.slots))
        pairs = combinations(range(1, self.slots + 1), 2)
        return (*variances, *(Channel(f"correlation_{i}_{j}", "") for i, j in pairs))

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        position = delayed_position(view, inputs, self.late)
        result = []
        for slot in range(self.slots):
            distances = []
            for end in (2 * slot, 2 * slot + 1):
                anchor = Vector.of(inputs["pairs"][3 * end + k] for k in range(3))
                distances.append((position - anchor).norm() + bias_in(view, TDOA, inputs["pair"][end]))
            result.append(distances[0] - distances[1])
        return result

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """The differences of the slots seen, each given those before."""
        n = self.slots
        reported = reading.reported if len(reading.reported) else [0.0] * (n + n * (n - 1) // 2)
        sigmas = [
            jnp.sqrt(self.sigma_d.value**2 + variance + rounding_variance(z))
            for z, variance in zip(reading.values, reported[:n], strict=True)
        ]
        covariance = [[sigma * sigma if i == j else 0.0 for j in range(n)] for i, sigma in enumerate(sigmas)]
        for (i, j), correlation in zip(combinations(range(n), 2), reported[n:], strict=True):
            covariance[j][i] = correlation * sigmas[i] * sigmas[j]
        differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
        return correlated(differences, covariance, list(reading.seen), self.dof.value)


def difference_tracker(
    anchors: int, slots: int = 1, planar: bool = False, sigma_a: float = 0.44, sigma_z: float = 0.7,
    memory: float = 5.5, sigma_d: float = 0.13, dof: float = 1.8, sigma_bias: float = 0.12,
    time_constant: float = 20.0, length: float = 2.0,
) -> Tracker:  # fmt: skip
    """Position and velocity from range differences, `slots` to a row; `planar`: at a known height.

    Motion numbers as in `DriftingBiases`, sensor numbers as in `RangeDifferenceSensor`. Motion and noise are as in
    `range_tracker`, a difference having the noise of two ranges; the biases, which hold clock errors and obstruction,
    too, are wider and shorter, by simulated rooms and three flights (docs/decisions.md). Above `MAX_BIASES` anchors the
    state has no biases.
    """
    require(is_count(anchors), "difference_tracker", anchors, "the number of anchors, as len(rig.anchors)")
    biases = anchors if anchors <= MAX_BIASES else 0
    return Tracker(
        DriftingBiases(biases, sigma_a, sigma_z, memory, sigma_bias, time_constant, length),
        {TDOA: RangeDifferenceSensor(slots, sigma_d, dof)},
        BiasedStart(Scale(1.0, "m"), Scale(1.0, "m/s"), Scale(sigma_bias, "m"), planar, biases),
        track_loss=TrackScorePolicy(REACH, "m"),
    )
