"""Times of rows since the first, s, exact enough between neighbours whatever the time before them.

One number of single precision has steps of 8 ms after a day, and of 128 s after a row at clock zero before rows since
1970; so each time is the sum of two.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from trackwright.trackers.core.model.algebra import Scalar


class Elapsed(NamedTuple):
    """The times of the rows of one trajectory, (T,) s: the sums of `whole` and `rest`, what rounding left of it."""

    whole: Float[Array, " T"]
    rest: Float[Array, " T"]

    @classmethod
    def of(cls, dt: Float[Array, " T"], longest: Scalar | float) -> Elapsed:
        """The times of rows `dt` s after those before; a gap longer than `longest` counts as that."""
        dt = jnp.minimum(dt, longest)
        whole = jnp.cumsum(dt)
        return cls(whole, jnp.cumsum(dt - jnp.diff(whole, prepend=0.0)))

    def since(self, first: Int[Array, " n"]) -> Float[Array, " T"]:
        """The time from the row `first` of each row to that row, s."""
        return (self.whole - self.whole[first]) + (self.rest - self.rest[first])

    def last_within(self, seconds: Float[Array, " T"]) -> Int[Array, " T"]:
        """The last row that is at most `seconds` after each row, which may be negative; −1 for none."""

        def halved(_: int, found: tuple[Int[Array, " T"], Int[Array, " T"]]) -> tuple[Array, Array]:
            low, high = found
            middle = (low + high) // 2
            inside = -self.since(middle) <= seconds
            return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

        rows = len(self.whole)
        low = jnp.full(rows, -1, jnp.int32)
        return jax.lax.fori_loop(0, rows.bit_length(), halved, (low, jnp.full(rows, rows, jnp.int32)))[0]
