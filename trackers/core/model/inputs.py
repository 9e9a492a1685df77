"""Known inputs: quantities of a row that motions, sensors, starts and filters read beside the measurements.

A part declares its inputs, so that a recording without one is refused before a run, and docs/inputs.md lists them all.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

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
