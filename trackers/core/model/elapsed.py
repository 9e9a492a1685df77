"""Elapsed times of rows, s, with exact differences between neighbours however long the recording.

One number in single precision has a spacing of 8 ms after a day, and of 128 s where a row at clock zero precedes times
since 1970; so each time is a sum of two numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from trackwright.trackers.core.model.algebra import Scalar


class Elapsed(NamedTuple):
    """The times of the rows of one trajectory, (T,) s: the sums of `whole` and of its rounding error, `rest`."""

    whole: Float[Array, " T"]
    rest: Float[Array, " T"]

    @classmethod
    def of(cls, dt: Float[Array, " T"], longest: Scalar | float) -> Elapsed:
        """The cumulative times of steps `dt` s, each at most `longest` s."""
        dt = jnp.minimum(dt, longest)
        whole = jnp.cumsum(dt)
        return cls(whole, jnp.cumsum(dt - jnp.diff(whole, prepend=0.0)))

    def since(self, first: Int[Array, " n"]) -> Float[Array, " T"]:
        """The time from row `first` to each row, s."""
        return (self.whole - self.whole[first]) + (self.rest - self.rest[first])

    def last_within(self, seconds: Float[Array, " T"]) -> Int[Array, " T"]:
        """The last row at most `seconds` after each row; −1 for none. `seconds` may be negative."""

        def halved(_: int, interval: tuple[Int[Array, " T"], Int[Array, " T"]]) -> tuple[Array, Array]:
            low, high = interval
            middle = (low + high) // 2
            inside = -self.since(middle) <= seconds
            return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

        rows = len(self.whole)
        low = jnp.full(rows, -1, jnp.int32)
        return jax.lax.fori_loop(0, rows.bit_length(), halved, (low, jnp.full(rows, rows, jnp.int32)))[0]
