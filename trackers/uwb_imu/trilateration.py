"""Positions of single rows: robust least squares, planar or in three dimensions, and the paper's trilateration.

Two-way ranging and trilateration are equations (8)–(17) of Kwon et al. 2021, corrected. The clock drift δ is the rate
of the responder's clock relative to the initiator's, less one; crystals keep it within 2e-5. With the reply delay t_r
the error of single-sided ranging is c·δ·t_r/2, 1.5 m at 1e-5 and 1 ms. That of double-sided ranging is the distance
times the mean error of both clocks' rates, 0.6 mm at 30 m and 2e-5.

Trilateration has confidence compensation. The paper computes the intersections of two circles with a division by y_j −
y_i: (13) has a sign error, (11) is relative to anchor i and its y is (b − aε)/(1 + a²), and anchors of equal y lead to
a division by zero. Here the points follow from the baseline vector between the anchors, without exceptions; the
corrected form of the paper gives the same points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import require
from trackwright.trackers.core.model.algebra import Scalar, Vector, triangle
from trackwright.trackers.core.model.inputs import HEIGHT, HEIGHT_LIMITS, Input, Need
from trackwright.trackers.core.model.motion import Noise, Placed
from trackwright.trackers.core.model.rig import mirrored
from trackwright.trackers.core.model.sensor import Channel, rounding_variance
from trackwright.trackers.core.model.tunable import Scale, freeze
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker
from trackwright.trackers.parts.multilaterate import PositionFit, multilaterate
from trackwright.trackers.parts.ranges import ANCHORS, RANGES

NO_ANCHORS = "True or False; anchors are in the recording"
SOLVED_AT_ONCE = 64  # rows of all trajectories solved side by side: operations on fewer numbers take as long


class Multilateration(AbstractEpochwiseTracker):
    """The position of every row with at least three ranges at a known height, else four.

    Readings under `name` with any number of slots; inputs `anchors` (3·slots,) m, `height` m and `height_limits` m.
    `sigma_r` m: standard deviation of a range; the Cauchy scale is three times it. Covariances are least-squares ones.
    """

    sigma_r: Noise
    name: str = eqx.field(static=True)
    planar: bool = eqx.field(static=True)

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that it reads."""
        return ANCHORS, HEIGHT, HEIGHT_LIMITS

    def check_layout(self, layout: Layout) -> None:
        layout.check_readings("Multilateration", self.name, 3 if self.planar else 4)
        needs = (Need.ALWAYS, Need.PLANAR if self.planar else Need.IF_GIVEN)
        layout.check_inputs("Multilateration", self.inputs, layout.readings[self.name][0], needs)

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        sigma = freeze(self).sigma_r.value
        reading, inputs = batch.readings[self.name], batch.inputs

        def solve(values: Any, seen: Any, anchors: Any, height: Scalar | None) -> PositionFit:
            return multilaterate(values, anchors.reshape(-1, 3), seen, height, 3.0 * sigma)

        # A block of rows at a time: solving all rows at once would keep every iteration of all of them in memory.
        arrays = (reading.values, reading.seen, inputs["anchors"], inputs["height"] if self.planar else None)
        block = jax.vmap(solve, in_axes=-1, out_axes=-1)
        rows = max(1, SOLVED_AT_ONCE // batch.size)
        fits = jax.lax.map(lambda x: block(*x), jax.tree_util.tree_map(lambda x: in_blocks(x, rows), arrays))
        fit = jax.tree_util.tree_map(lambda x: out_of_blocks(x, rows, *jnp.shape(batch.dt)), fits)
        zero, n = jnp.zeros_like(fit.cost), 2 if self.planar else 3
        place, turned = [fit.position[:, k] for k in range(n)], jnp.ones_like(zero)
        if HEIGHT_LIMITS.name in inputs and not self.planar:
            place[2] = mirrored(place[2], jnp.moveaxis(inputs[HEIGHT_LIMITS.name], 1, 0))
            turned = jnp.where(place[2] == fit.position[:, 2], 1.0, -1.0)
        mean = Placed(Vector(*place))
        variance = sigma**2 + rounding_variance(jnp.max(jnp.where(reading.seen, reading.values, 0.0), axis=1))
        cov = tuple(variance * fit.covariance[:, i, j] * (turned if i < j == 2 else 1.0) for i, j in triangle(n))
        valid = jnp.asarray(batch.valid)
        status = jnp.where(valid, jnp.where(fit.determined, Status.OK, Status.WAITING), Status.PADDING)
        return Output(mean, cov, zero, zero, zero, zero, status.astype(jnp.int8)), ()


def in_blocks(x: Any, rows: int) -> Any:
    """Arrays (T, …, B) as blocks of `rows` rows side by side, (T / rows, …, rows · B), padded with zeros."""
    x = jnp.asarray(x)
    padding = [(0, -len(x) % rows)] + [(0, 0)] * (x.ndim - 1)
    blocks = jnp.pad(x, padding).reshape(-1, rows, *x.shape[1:])
    return jnp.moveaxis(blocks, 1, -2).reshape(len(blocks), *x.shape[1:-1], rows * x.shape[-1])


def out_of_blocks(blocks: Any, rows: int, count: int, size: int) -> Any:
    """Blocks of rows side by side as arrays (`count`, …, `size`), without the padding."""
    each = jnp.moveaxis(blocks.reshape(*blocks.shape[:-1], rows, size), -2, 1)
    return each.reshape(-1, *blocks.shape[1:-1], size)[:count]


def multilateration_tracker(planar: bool = False, sigma_r: float = 0.1) -> Multilateration:
    """Robust least squares on the ranges of each row; `sigma_r` m. `planar`: at the tag's known height."""
    require(isinstance(planar, bool), "multilateration_tracker: planar", planar, NO_ANCHORS)
    return Multilateration(Scale(sigma_r, "m"), RANGES, planar)


def compensation(sigma: Scalar) -> Scalar:
    """The term that (14) and (15) add to a range, m: the half-width 1.96 J/√N of its 95 % interval, for three anchors.

    J is taken as the range's standard deviation, m; the paper calls it a Cramér–Rao bound without a unit. The term
    always lengthens a range.
    """
    return 1.96 * sigma / 3**0.5


def intersections(first: Vector, second: Vector, radius: Scalar, other: Scalar) -> tuple[Vector, Vector]:
    """Both intersections, m, of two circles about anchors (x, y): (10), by the baseline vector.

    Circles that do not intersect give the middle of the gap between them twice; anchors at the same position give the
    first anchor.
    """
    baseline = second - first
    square = baseline.dot(baseline)
    distinct = square > 0
    length = jnp.sqrt(jnp.where(distinct, square, 1.0))
    unit = baseline * jnp.where(distinct, 1.0 / length, 0.0)
    along = (length * length + radius * radius - other * other) / (2.0 * length)
    height = radius * radius - along * along
    intersect = height > 0
    # Middle of the gap, along the baseline: between separate circles, or between nested ones.
    separate = (radius + length - other) / 2.0
    nested = jnp.where(radius > other, (radius + length + other) / 2.0, -(radius + other - length) / 2.0)
    # Circles that do not intersect are separate if the distance of the anchors exceeds both radii.
    gap = jnp.where(length > jnp.maximum(radius, other), separate, nested)
    foot = first + unit * jnp.where(intersect, along, gap)
    rise = jnp.where(intersect, jnp.sqrt(jnp.where(intersect, height, 1.0)), 0.0)
    normal = Vector(-unit[1], unit[0]) * rise
    return foot + normal, foot - normal


def nearer(points: tuple[Vector, Vector], anchor: Vector, radius: Scalar) -> Vector:
    """The point, of two, nearer to a third anchor's circle: (16)."""
    error = [(radius - (p - anchor).norm()) ** 2 for p in points]
    return Vector.of(jnp.where(error[0] < error[1], a, b) for a, b in zip(*points, strict=True))


def trilaterate(anchors: Sequence[Vector], radii: Sequence[Scalar]) -> Vector:
    """The centroid, m, of the chosen intersections of three circles about anchors (x, y): (16) and (17)."""
    chosen = []
    for i, j, k in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
        points = intersections(anchors[i], anchors[j], radii[i], radii[j])
        chosen.append(nearer(points, anchors[k], radii[k]))
    return (chosen[0] + chosen[1] + chosen[2]) / 3.0


def horizontal_range(slant: Scalar, drop: Scalar) -> Scalar:
    """The horizontal component of a range, m, to an anchor `drop` m above or below the tag; 0 for a shorter range."""
    square = slant * slant - drop * drop
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


class Trilateration(AbstractEpochwiseTracker):
    """The paper's planar position on every row with three ranges, at the tag's known height.

    Readings under `name` with three slots; inputs `anchors` (9,) m and `height` m. `sigma_r` m: J of the compensation
    (14), which is added if `compensated`. The covariance is NaN.
    """

    sigma_r: Noise
    name: str = eqx.field(static=True)
    compensated: bool = eqx.field(static=True)

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The known inputs that it reads."""
        return ANCHORS, HEIGHT

    def check_layout(self, layout: Layout) -> None:
        layout.check_readings("Trilateration", self.name, [Channel(f"range_{k}", "m") for k in (1, 2, 3)])
        layout.check_inputs("Trilateration", self.inputs, layout.readings[self.name][0], (Need.ALWAYS, Need.PLANAR))

    def scan(self, batch: Batch, initial: Any = None) -> tuple[Output, Any]:
        model = freeze(self)
        reading, inputs = batch.readings[self.name], batch.inputs
        seen = jnp.all(jnp.asarray(reading.seen), axis=1) & jnp.asarray(batch.valid)

        def solve(values: Any, anchors: Any, height: Scalar) -> Vector:
            added = compensation(model.sigma_r.value) if self.compensated else 0.0
            radii = [horizontal_range(values[k] + added, anchors[3 * k + 2] - height) for k in range(3)]
            return trilaterate([Vector(anchors[3 * k], anchors[3 * k + 1]) for k in range(3)], radii)

        rows = jax.vmap(jax.vmap(solve, in_axes=-1, out_axes=-1))
        position = rows(*(jnp.asarray(x) for x in (reading.values, inputs["anchors"], inputs["height"])))
        zero = jnp.zeros_like(position[0])
        status = jnp.where(seen, Status.OK, jnp.where(jnp.asarray(batch.valid), Status.WAITING, Status.PADDING))
        cov = tuple(zero + jnp.nan for _ in triangle(2))
        # Zeros on rows without three ranges: no masked reading affects an estimate.
        mean = Placed(Vector.of(jnp.where(seen, x, 0.0) for x in position))
        return Output(mean, cov, zero, zero, zero, zero, status.astype(jnp.int8)), ()


def trilateration_tracker(compensated: bool = True, sigma_r: float = 0.1) -> Trilateration:
    """Trilateration of rows with three ranges, with or without the paper's compensation (14); `sigma_r` m."""
    require(isinstance(compensated, bool), "trilateration_tracker: compensated", compensated, NO_ANCHORS)
    return Trilateration(Scale(sigma_r, "m"), RANGES, compensated)


SPEED_OF_LIGHT = 299_792_458.0  # m/s; the paper rounds to 3e8, an error of 7 mm in ten metres


def single_sided(total: Any, reply: Any, drift: Any = 0.0) -> np.ndarray:
    """Distance, m, by single-sided two-way ranging (Kwon et al. 2021, equations 8 and 9).

    `total`: round-trip time t₂ − t₁ by the initiator's clock, s. `reply`: reply delay t_r by the responder's clock, s,
    corrected for its `drift`.
    """
    flight = (np.asarray(total, float) - np.asarray(reply, float) / (1.0 + np.asarray(drift, float))) / 2.0
    return np.asarray(SPEED_OF_LIGHT * flight)


def double_sided(total: Any, reply: Any, second_total: Any, second_reply: Any) -> np.ndarray:
    """Distance, m, by double-sided two-way ranging: two round-trip times and two reply delays, all s.

    `total` and `second_reply` by the initiator's clock, `reply` and `second_total` by the responder's. The error
    does not depend on the delays (Neirynck, Luk, McLaughlin 2016, equation 12).
    """
    first, second, delay, second_delay = (np.asarray(x, float) for x in (total, second_total, reply, second_reply))
    flight = (first * second - delay * second_delay) / (first + second + delay + second_delay)
    return np.asarray(SPEED_OF_LIGHT * flight)
