"""What a row holds beside its measurements: known inputs, a random key, and the time since an earlier row.

A part declares its inputs, so that a recording without one is refused before a run, and docs/inputs.md lists them all.
Random keys are from (seed, trajectory id), by the counter-based generator Threefry-2x32 (Salmon et al. 2011).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

AnyArray = Array | np.ndarray
"""An array of JAX, which may be traced, or one on the host."""

Inputs = Mapping[str, AnyArray]
"""The known inputs of one row by name: numbers, or arrays of them."""


class Need(Enum):
    """When a part reads an input."""

    ALWAYS = "always"
    PLANAR = "for a planar state"
    IF_GIVEN = "if given"


class Input(NamedTuple):
    """A known input: a recording holds an array (T, *shape) under `name`.

    `about`: its meaning in one phrase. `source`: how to make it, the usual fix in messages. `per_channel`: whether
    `shape` is for one channel of the readings; a row then holds the numbers of all channels, flattened. `below`: the
    values are whole numbers from 0 to below − 1; None for any number.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    about: str
    source: str = ""
    need: Need = Need.ALWAYS
    per_channel: bool = False
    below: int | None = None

    def row_shape(self, channels: int) -> tuple[int, ...]:
        """The shape of one row, for readings with this number of channels."""
        if not self.per_channel:
            return self.shape
        return (channels * (self.shape[0] if self.shape else 1),)


HEIGHT = Input(
    "height",
    (),
    "m",
    "the known height of the tag",
    "`height=` of `fix_recording`, `range_recording`, `bearing_recording` or `phase_recording`",
    Need.PLANAR,
)
"""The input that completes a planar position to one in space: `sensor.position_in_space`."""

HEIGHT_LIMITS = Input(
    "height_limits", (2,), "m", "lowest and highest height of a tag", "`range_recording`", Need.IF_GIVEN
)
"""The input with the side of the anchors' plane on which a tag is."""

RawKey = UInt32[Array | np.ndarray, " 2"]
"""A raw random key."""

Words = UInt32[Array | np.ndarray, "..."]
"""Random words, counters, or both halves of a key."""

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)


def threefry(key: Words, x: Words, y: Words) -> tuple[Words, Words]:
    """The two random words for each pair of counters `x`, `y`, (n,) uint32, under a raw key (2,) uint32; 20 rounds."""
    keys = key[0], key[1], key[0] ^ key[1] ^ PARITY
    x, y = x + keys[0], y + keys[1]
    for group in range(5):
        for turn in ROTATIONS[group % 2]:
            x = x + y
            y = (y << np.uint32(turn)) | (y >> np.uint32(32 - turn))
            y = y ^ x
        x, y = x + keys[(group + 1) % 3], y + keys[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def trajectory_key_data(seed: int, ids: Sequence[int]) -> UInt32[np.ndarray, "2 n"]:
    """The raw random keys (2, n), uint32, of trajectories: each a function of the seed and the trajectory's id alone.

    Different ids have different keys. Raises ValueError for seeds and ids that are no whole numbers from 0 to 2^64 - 1.
    """
    for k, x in enumerate((seed, *ids)):
        if not (isinstance(x, (int, np.integer)) and 0 <= x < 2**64):
            what = "a trajectory id" if k else "the seed"
            raise ValueError(f"{what} is {x!r}; expected a whole number from 0 to 2^64 - 1")
    # The high and low 32 bits of each number; the sums of the generator wrap.
    key, *words = np.array([[int(x) >> 32, int(x) & 0xFFFFFFFF] for x in (seed, *ids)], np.uint32)
    with np.errstate(over="ignore"):
        return np.stack(threefry(key, *np.reshape(words, (-1, 2)).T))


class Elapsed(NamedTuple):
    """The times of the rows of one trajectory, (T,) s: the sums of `whole` and of its rounding error, `rest`.

    Differences between neighbours are exact however long the recording: one number in single precision has a spacing
    of 8 ms after a day, and of 128 s where a row at clock zero precedes times since 1970.
    """

    whole: Float[Array, " T"]
    rest: Float[Array, " T"]

    @classmethod
    def of(cls, dt: Float[Array, " T"], longest: Any) -> Elapsed:
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
