"""A change of the readings, the truth or the rig that may explain large errors, and the errors with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from trackwright.trackers.recordings.checks.compared import Compared

PENALTY = 0.06
"""Log ratio of errors by which a fitted number must pay."""

FACTORS = (
    (0.001, "millimetres"), (0.01, "centimetres"), (0.3048, "feet"), (0.0254, "inches"), (1000.0, "kilometres"),
)  # fmt: skip
"""Metres per unit."""


class Explanation(NamedTuple):
    """`change`: what makes the errors small, in words after "with"; `cause`: the most likely mistake, and its fix.

    `sizes` (G, m): the median errors of groups and columns with it. `parameters`: how many numbers were fitted for it.
    `own`: each group has numbers of its own, or the change may concern some groups alone. `groups` (G,): those that it
    may concern, all of them or none if `together`, and few of them if it changes a `place`: of many it is the frame.
    `harmless`: a property of the sensor and no mistake. `parts`: what to name of each group, if anything.
    """

    change: str
    cause: str
    sizes: Float[np.ndarray, "G m"]
    parameters: int = 0
    own: bool = False
    groups: Bool[np.ndarray, " G"] | None = None
    together: bool = False
    place: bool = False
    harmless: bool = False
    parts: tuple[str, ...] = ()


def sizes_with(view: Compared, **changed: np.ndarray) -> Float[np.ndarray, "G m"]:
    """The median errors with other values, positions, places or rotations."""
    other = view._replace(**changed)  # type: ignore[arg-type]
    return other.sizes(other.errors())


def transform_text(numbers: Sequence[float]) -> str:
    """Shift, m, turn about z, °, and seconds as `import --transform` takes them: `1.200,-0.300,0.000,37.000`."""
    return ",".join(f"{round(float(x), 3) + 0.0:.3f}" for x in numbers)


def metres(vector: np.ndarray) -> str:
    """A vector in metres: `(1.20, -0.30, 0.00) m`."""
    return f"({', '.join(f'{x + 0.0:.2f}' for x in np.round(vector, 2))}) m"


class SignedAxes(NamedTuple):
    """Axes exchanged or with another sign: new axis k is `signs[k]` times axis `order[k]`; `changes`: how many."""

    order: tuple[int, ...]
    signs: Float[np.ndarray, " 3"]
    words: str
    changes: int

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The matrix that takes vectors to the new axes."""
        matrix: np.ndarray = self.signs[:, None] * np.eye(3)[list(self.order)]
        return matrix

    @property
    def mirrored(self) -> bool:
        """Whether they are left-handed."""
        return bool(np.linalg.det(self.matrix) < 0)


def signed_axes(of: str) -> Iterator[SignedAxes]:
    """All 48 axes, as they are first; the words name the changes of what they are `of`."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            flipped = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0]
            turned = [k for k in range(3) if order[k] != k]
            words = []
            if len(turned) == 2:
                words.append(f"{'xyz'[turned[0]]} and {'xyz'[turned[1]]} of {of} swapped")
            elif turned:
                words.append(f"x, y, z of {of} read as {', '.join('xyz'[k] for k in order)}")
            if flipped:
                signs_of = "the sign of" if len(flipped) == 1 else "the signs of"
                words.append(f"{signs_of} {', '.join(flipped)}{'' if words else f' of {of}'} flipped")
            yield SignedAxes(order, np.array(signs), " and ".join(words), len(words + flipped))
