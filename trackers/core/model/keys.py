"""Random keys from (seed, trajectory id), by the counter-based generator Threefry-2x32 (Salmon et al. 2011)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, UInt32

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
    for what, numbers in (("the seed", [seed]), ("a trajectory id", ids)):
        wrong = next((x for x in numbers if not (isinstance(x, (int, np.integer)) and 0 <= x < 2**64)), None)
        if wrong is not None:
            raise ValueError(f"{what} is {wrong!r}; expected a whole number from 0 to 2^64 - 1")
    (key,), words = _words([seed]), _words(ids)
    # The sums of the generator wrap.
    with np.errstate(over="ignore"):
        return np.stack(threefry(key, words[:, 0], words[:, 1]))


def _words(numbers: Sequence[int]) -> UInt32[np.ndarray, "n 2"]:
    """The high and low 32 bits of each number, (n, 2)."""
    return np.array([[int(x) >> 32, int(x) & 0xFFFFFFFF] for x in numbers], np.uint32).reshape(-1, 2)
