"""Multilateration: the place that fits all ranges of a row best, over the floor or in space, wild ranges forgotten."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from trackers.core.algebra import Scalar, Vector, triangle
from trackers.core.estimates import Status
from trackers.core.motion import Noise, Placed
from trackers.core.recording import Batch
from trackers.core.scan import Output
from trackers.core.tracker import AbstractEpochwiseTracker
from trackers.core.tunable import Scale, freeze
from trackers.parts.multilaterate import Place, multilaterate
from trackers.parts.ranges import RANGES


class Multilateration(AbstractEpochwiseTracker):
    """The place of every row with enough ranges: more than two at a known height, else more than three.

    Readings under `name`, any number of slots; inputs `anchors` (3·slots,) m and `height` m. `sigma_r` m: from where a
    range loses its say; the covariance is that of least squares with it.
    """

    sigma_r: Noise
    name: str = eqx.field(static=True)
    planar: bool = eqx.field(static=True)

    def scan(self, batch: Batch) -> Output:
        sigma = freeze(self).sigma_r.value
        reading, inputs = batch.readings[self.name], batch.inputs

        def fix(values: Any, seen: Any, anchors: Any, height: Scalar) -> Place:
            at = height if self.planar else None
            return multilaterate(values, anchors.reshape(-1, 3), seen, at, 3.0 * sigma)

        # A row at a time: the search of all rows at once would hold every step of all of them.
        row = jax.vmap(fix, in_axes=-1, out_axes=-1)
        arrays = (reading.values, reading.seen, inputs["anchors"], inputs["height"])
        place = jax.lax.map(lambda x: row(*x), jax.tree_util.tree_map(jnp.asarray, arrays))
        zero, n = jnp.zeros_like(place.misfit), 2 if self.planar else 3
        mean = Placed(Vector(*(place.position[:, k] for k in range(n))))
        cov = tuple(sigma**2 * place.spread[:, i, j] for i, j in triangle(n))
        valid = jnp.asarray(batch.valid)
        status = jnp.where(valid, jnp.where(place.determined, Status.OK, Status.WAITING), Status.PADDING)
        return Output(mean, cov, zero, zero, zero, zero, status.astype(jnp.int8))


def multilateration_tracker(planar: bool = False, sigma_r: float = 0.1) -> Multilateration:
    """Robust least squares on each row of ranges, σr m; at the tag's known height where `planar`."""
    return Multilateration(Scale(sigma_r, "m"), RANGES, planar)
