"""Range sensor, shared by trackers with and without an IMU (Kwon et al. 2021, equations 27–30), and rows of ranges.

A row has a fixed number of slots, each for a range to any anchor. The anchor's number and position are inputs of the
row, so that ranges may arrive one at a time or together, and recordings of different installations share a tracker.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import polars as pl

from trackwright.trackers.core.data.recording import Readings
from trackwright.trackers.core.model.algebra import Scalar, Vector, total
from trackwright.trackers.core.model.inputs import HEIGHT, HEIGHT_LIMITS, Input, Inputs, Need
from trackwright.trackers.core.model.motion import Noise
from trackwright.trackers.core.model.rig import Rig, mirrored, room_rows
from trackwright.trackers.core.model.sensor import (
    AbstractSensor,
    Channel,
    Reading,
    Residual,
    delayed_position,
    rounding_variance,
    student_t_log_peak,
)
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.model.tunable import Real, Scale
from trackwright.trackers.core.run.track_loss import ROOM
from trackwright.trackers.parts.multilaterate import RangePlaces, recent_positions, recent_rows
from trackwright.trackers.parts.start_nearby import NEARBY, last_of_times
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Trajectories, known_heights, trajectories_of

RANGES = "ranges"

ANCHORS = Input(
    "anchors", (3,), "m", "x, y, z of the anchor of each slot", "`range_recording(anchors=)`", per_channel=True
)
"""The input with the anchors' positions."""


class RangeSensor(AbstractSensor):
    """Distances, m, from a tag at `view.position` to the anchors of this row's slots (Kwon et al. 2021, equation 29).

    Inputs: `anchors` (3·slots,) m, x, y, z of each slot's anchor; `anchor` (slots,), its number; `height` m for a
    planar state; optionally `levers` (3·slots,) m, the lever arm of each slot's tag in body axes, for a view with an
    `attitude`. The predicted range includes the tunable `bias` and, if present, `view.bias`, both m per anchor, and
    `view.shared`, m, common to all anchors.

    Residuals follow a two-piece Student's t with `dof` degrees of freedom, of scale `sigma_r` m below zero and
    `positive_skew`·`sigma_r` above: ranges are too long more often than too short. Reported variances, m², one per
    slot, add to the variance of `sigma_r`. `late`: by how many seconds the times of ranges are later than of the other
    readings at the same position.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    sigma_r: Noise
    positive_skew: Noise
    dof: Noise
    bias: Noise
    slots: int = eqx.field(static=True)
    late: Noise | None

    def __init__(self, slots: int, anchors: int, sigma_r: float, positive_skew: float, dof: float, bias: float = 0.0):
        """`slots`: ranges per row; `anchors`: number of biases; `bias`: their initial value, m."""
        self.slots = slots
        self.sigma_r = Scale(sigma_r, "m", "measurement noise")
        self.positive_skew = Scale(positive_skew)
        self.dof = Scale(dof)
        self.bias = Real(np.full(anchors, bias), "m", typical=0.1)
        self.late = None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One range per slot, m."""
        return tuple(Channel(f"range_{k + 1}", "m") for k in range(self.slots))

    @property
    def inputs(self) -> tuple[Input, ...]:
        number = Input(
            "anchor",
            (1,),
            "",
            "the number of the anchor of each slot, from 0",
            "`range_recording`, which counts the anchors in the order given",
            per_channel=True,
            # A sensor built for no anchor has no biases, and serves any number of anchors.
            below=np.shape(self.bias.value)[0] or None,
        )
        levers = Input(
            "levers",
            (3,),
            "m",
            "the lever arm, in body axes, of the tag of each slot, for a view with an `attitude`",
            "`offset_m` of the tags in rig.toml",
            Need.IF_GIVEN,
            per_channel=True,
        )
        return ANCHORS, number, HEIGHT, levers

    @property
    def reported(self) -> tuple[Channel, ...]:
        """The variance of the range of each slot, m²."""
        return tuple(Channel(f"variance_{k + 1}", "m^2") for k in range(self.slots))

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        position = delayed_position(view, inputs, self.late)
        ranges = []
        for slot in range(self.slots):
            tag = position
            if "levers" in inputs and hasattr(view, "attitude"):
                lever = Vector.of(inputs["levers"][3 * slot + k] for k in range(3))
                tag = position + in_world_axes(view.attitude, lever)
            anchor = Vector.of(inputs["anchors"][3 * slot + k] for k in range(3))
            number = inputs["anchor"][slot]
            bias = entry_at(self.bias.value, number) + bias_in(view, RANGES, number)
            for shared in getattr(view, "shared", ()):
                bias = bias + shared
            ranges.append((tag - anchor).norm() + bias)
        return ranges

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """Each slot's difference over the scale of its sign; the two halves of the density agree at its peak."""
        positive_skew, dof = self.positive_skew.value, self.dof.value
        variances = reading.reported if len(reading.reported) else [0.0] * self.slots
        whitened, log_scales = [], []
        for z, p, seen, variance in zip(reading.values, predicted, reading.seen, variances, strict=True):
            # Long ranges are rounded in single precision.
            sigma = jnp.sqrt(self.sigma_r.value**2 + variance + rounding_variance(z))
            whitened.append(jnp.where(seen, (z - p) / jnp.where(z > p, sigma * positive_skew, sigma), 0.0))
            peak = student_t_log_peak(dof) - jnp.log(sigma) - jnp.log(0.5 * (1.0 + positive_skew))
            log_scales.append(jnp.where(seen, peak, 0.0))
        nis_dof = total(jnp.where(seen, jnp.ones_like(whitened[0]), 0.0) for seen in reading.seen)
        return Residual(whitened, total(log_scales), nis_dof, dof=dof)


def with_delay(sensor: AbstractSensor) -> AbstractSensor:
    """The sensor with the tunable `late`, which shows beside readings of another clock, such as an IMU's."""
    return eqx.tree_at(lambda x: x.late, sensor, Real(0.0, "s", typical=0.05), is_leaf=lambda x: x is None)


def in_world_axes(attitude: Any, vector: Vector) -> Vector:
    """A vector in body axes, in world axes; `attitude`: a `Rotation`, or a `Heading` about the vertical."""
    if isinstance(attitude, Heading):
        cosine, sine = jnp.cos(attitude.angle), jnp.sin(attitude.angle)
        x, y, z = vector
        return Vector(cosine * x - sine * y, sine * x + cosine * y, z)
    rotated: Vector = attitude.apply(vector)
    return rotated


def bias_in(view: Any, kind: str, number: Scalar) -> Scalar:
    """The bias of this number in `view.bias`, where that has several kinds' biases in the kind's; 0 without any."""
    biases = getattr(view, "bias", None)
    if isinstance(biases, dict):
        biases = biases.get(kind)
    return 0.0 if biases is None else entry_at(biases, number)


def entry_at(values: Any, number: Scalar) -> Scalar:
    """`values[number]`, 0 out of bounds, as a sum of selections: under vmap faster than a gather."""
    count = len(values) if isinstance(values, Vector) else np.shape(values)[0]
    return total(jnp.where(number == k, values[k], 0.0) for k in range(count))


# Ratio of the horizontal singular values of the anchor positions below which the anchors count as collinear.
COLLINEAR = 1e-2
# The column with the tag of each range where ranges of several tags are rows of one trajectory.
CARRIER = "tag of the body"


def range_trajectories(folder: RecordingFolder, free_height: bool) -> Trajectories:
    """Each tag's ranges, one row per table row, with the inputs of `range_inputs`, and `room`."""
    rows = folder.rows("ranges")
    readings, number = range_rows(folder, rows)
    heights = np.full(len(rows.tags), np.nan) if free_height else known_heights(folder, rows.tags)
    anchors = anchor_positions(folder)
    inputs = range_inputs(rows.starts, rows.times, readings, number, anchors, heights, folder.rig)
    inputs |= room_of_anchors(folder, len(number))
    return trajectories_of(folder, rows.tags, rows.starts, rows.times, {RANGES: readings}, inputs)


def range_rows(folder: RecordingFolder, rows: TagRows) -> tuple[Readings, np.ndarray]:
    """The readings of ranges, one row per row of the table, and the number of each range's anchor (N,).

    Anchors are numbered in the order of their ids. Ranges that are not positive are masked. Where the folder has a
    calibration, ranges are without the systematic errors of their anchor and tag, and have the variance that these add.
    """
    values, seen = rows.values(["range_m"])
    seen &= values > 0.0
    anchors = sorted(folder.rig.anchors)
    number = rows.codes("anchor", anchors)
    variances = rows.variances(["range_std_m"])
    if folder.calibration is not None:
        # The ranges of several tags on one body are rows of one trajectory.
        tags = sorted(folder.tables["ranges"]["tag"].cast(pl.String).unique()) if CARRIER in rows else rows.tags
        tag = rows.codes(CARRIER, tags) if CARRIER in rows else rows.of_each(np.arange(len(tags)))
        distances, added = folder.calibration.of_ranges(anchors, number, tags, tag, values[:, 0])
        values, variances = np.where(seen, distances[:, None], 0.0), variances + added[:, None]
        seen &= values > 0.0
    return Readings(values, seen, variances), number


def range_inputs(
    starts: np.ndarray, times: np.ndarray, readings: Readings, number: np.ndarray, anchors: np.ndarray,
    heights: np.ndarray, rig: Rig,
) -> dict[str, np.ndarray]:  # fmt: skip
    """The inputs of rows with one range each: `anchors`, `anchor`, its number, `nearby` and `height_limits`.

    `starts` (n + 1,): the first row of each of n tags, then N. `number` (N,): of each range's anchor in `anchors`
    (A, 3). `heights` (n,) m: of the tags, NaN where unknown.
    """
    nearby = recent_positions(starts, times, anchors, number, readings.values[:, 0], readings.seen[:, 0], heights)
    return {"anchors": anchors[number], "anchor": number[:, None].astype(float), **within_limits(nearby, rig)}


def range_places(trajectories: Trajectories, planar: bool) -> RangePlaces:
    """How the input `nearby` of one tag's rows follows from its ranges; `planar`: at the known height."""
    rows, folder = trajectories.columns, trajectories.folders[0]
    anchors, number = anchor_positions(folder), rows.inputs["anchor"][:, 0].astype(int)
    seen, (last, of_row) = rows.readings[RANGES].seen[:, 0], last_of_times(rows.starts, rows.times)
    recent, windows = recent_rows(last, rows.starts, rows.times, number, seen, len(anchors))
    height, slots = float(trajectories.heights[0]) if planar else None, int((windows > 1).sum(axis=2).max())
    return RangePlaces(recent, windows, of_row, anchors, height, folder.rig.height_limits(), slots)


def within_limits(nearby: np.ndarray, rig: Rig) -> dict[str, np.ndarray]:
    """The inputs `height_limits` and `nearby` (N, 4), with heights on the likely side of the anchors' plane."""
    limits = rig.height_limits()
    nearby[:, 2] = np.where(nearby[:, 3] > 0, mirrored(nearby[:, 2], limits), 0.0)
    return {NEARBY.name: nearby, HEIGHT_LIMITS.name: np.broadcast_to(limits, (len(nearby), 2))}


def anchor_positions(folder: RecordingFolder) -> np.ndarray:
    """The anchors' positions (A, 3), m, in the order of their ids."""
    return np.stack([np.asarray(folder.rig.anchors[a], float) for a in sorted(folder.rig.anchors)])


def lacks_anchors(
    folder: RecordingFolder, rows: TagRows, seen: np.ndarray, numbers: np.ndarray, least: int, what: str
) -> str | None:
    """What readings lack for a position, in words: `least` anchors of a tag of known height, else one more; a plane.

    `seen` (N,): the rows of readings; `numbers` (N, k): of their anchors. `what`: they are called, up to their number.
    """
    tag, heard = rows.of_each(np.arange(len(rows.tags))), np.zeros((len(rows.tags), len(folder.rig.anchors)), bool)
    heard[tag[seen, None], numbers[seen]] = True
    counts, needed = heard.sum(axis=1), np.where(np.isnan(known_heights(folder, rows.tags)), least + 1, least)
    if not (counts >= needed).any():
        where = f"at least {least} anchors, or {least + 1} where rig.toml gives it no height_m"
        return f"{what} {where}, found {counts.max(initial=0)} at most"
    positions = anchor_positions(folder)[heard.any(axis=0), :2]
    sizes = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if sizes[1] > COLLINEAR * sizes[0]:
        return None
    return f"anchors that span a plane, found all {len(positions)} on one line or at one place seen from above"


def room_of_anchors(folder: RecordingFolder, rows: int) -> dict[str, np.ndarray]:
    """The input `room` for this number of rows, from the folder's floor or its anchors."""
    return {ROOM.name: room_rows(anchor_positions(folder), folder.rig.outline, rows)}
