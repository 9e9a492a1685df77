"""Baseline: robust least-squares position from the ranges of each row, planar or in three dimensions."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import require
from trackwright.trackers.core.model.algebra import Scalar, Vector, triangle
from trackwright.trackers.core.model.inputs import HEIGHT, HEIGHT_LIMITS, Input, Need
from trackwright.trackers.core.model.motion import Noise, Placed
from trackwright.trackers.core.model.rig import mirrored
from trackwright.trackers.core.model.sensor import rounding_variance
from trackwright.trackers.core.model.tunable import Scale, freeze
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractEpochwiseTracker
from trackwright.trackers.parts.multilaterate import PositionFit, multilaterate
from trackwright.trackers.parts.ranges import ANCHORS, RANGES

SOLVED_AT_ONCE = 64
"""Rows of all trajectories solved side by side: operations on fewer numbers take as long."""


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
    require(
        isinstance(planar, bool),
        "multilateration_tracker: planar",
        planar,
        "True or False; anchors are in the recording",
    )
    return Multilateration(Scale(sigma_r, "m"), RANGES, planar)
