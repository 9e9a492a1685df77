"""What a survey found: anchors with delays, intervals and verdicts, and their table."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.data.frames import text_lines
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import WIDTH
from trackwright.trackers.recordings.calibration import RANGE_PRIOR

COMMON_DELAY, OWN_DELAY = RANGE_PRIOR[1][0], 0.1
"""Standard deviations of delays before any range, m: of what all anchors share, and of each anchor's own."""

DETERMINED, WEAK, UNSEEN = 0.25, 1.0, 100.0
"""Half-widths of 95 % intervals, m: the largest of determined and of weak coordinates, the least of unseen ones."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Survey:
    """Anchors with their positions and delays.

    `names` (A,); `positions` (A, 3) m; `delays` (A,) m; `covariance` (4A, 4A), m²: of x, y, z and delay of each anchor
    in turn, zero where the frame or exact values fix them. `mirrored` (A,): whether the mirror image of the anchor on
    the other side of the walk's plane fits as well. `scales`, `rms`, m, and `readings` (A,): of errors. `densities`
    (walks,): of the tags' accelerations, m²/s³. `effect`: by how much errors that last widen variances. `paths`:
    positions (n, 3), m, of the tag in each walk. `rig`: that of the first recording with these anchors, rounded to
    0.1 mm. `notes`: what was assumed, a line each.
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "A 3"]
    delays: Float[np.ndarray, " A"]
    covariance: Float[np.ndarray, "U U"]
    mirrored: Bool[np.ndarray, " A"]
    scales: Float[np.ndarray, " A"]
    densities: Float[np.ndarray, " walks"]
    rms: Float[np.ndarray, " A"]
    readings: Int[np.ndarray, " A"]
    effect: float
    paths: tuple[Float[np.ndarray, "_ 3"], ...]
    rig: Rig
    notes: tuple[str, ...]

    head: ClassVar = ("anchor", "x, m", "y, m", "z, m", "delay, m", "rms, cm", "ranges", "verdict")

    @property
    def half_widths(self) -> Float[np.ndarray, "A 4"]:
        """Those of the 95 % intervals of x, y, z and delay, m."""
        return NORMAL * np.sqrt(np.diag(self.covariance)).reshape(-1, 4)

    def block(self, k: int) -> Float[np.ndarray, "4 4"]:
        """The covariance of position and delay of anchor number `k`, m²."""
        return self.covariance[4 * k : 4 * k + 4, 4 * k : 4 * k + 4]

    @property
    def delay_determined(self) -> Bool[np.ndarray, " A"]:
        """Whether the ranges determine a delay better than what was known before."""
        return self.half_widths[:, 3] < 0.7 * NORMAL * np.hypot(COMMON_DELAY, OWN_DELAY)

    def determined(self, name: str) -> tuple[bool, bool]:
        """Whether x and y, and whether the height of an anchor are determined; raises UnusableInput for others."""
        flat, height = self._extents(self._number(name))
        return flat <= DETERMINED, height <= DETERMINED

    def verdict(self, name: str) -> str:
        """Whether an anchor is determined, and otherwise what walk would determine it; raises as `determined`."""
        k = self._number(name)
        third = "above or below the walk" if self.mirrored[k] else "height"
        doubts = list(zip(self._extents(k), ("x, y", third), strict=True))
        unknown = [what for extent, what in doubts if not extent <= WEAK]
        weak = [what for extent, what in doubts if DETERMINED < extent <= WEAK]
        words = [f"{how}: {', '.join(of)}" for how, of in (("not determined", unknown), ("weak", weak)) if of]
        return f"{'; '.join(words)} ({self._advice(k)})" if words else "determined"

    def _number(self, name: str) -> int:
        if name not in self.names:
            expected = f"expected one of {listed(self.names, 12)}; correct its id"
            raise UnusableInput(f"{name!r}: no anchor of the survey; {expected}")
        return self.names.index(name)

    def _extents(self, k: int) -> tuple[float, float]:
        """Half the largest horizontal axis of the 95 % interval of anchor `k`, and of its height, m."""
        block = self.block(k)
        height = np.inf if self.mirrored[k] else NORMAL * float(np.sqrt(block[2, 2]))
        return NORMAL * float(np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1])), height

    def _advice(self, k: int) -> str:
        """The walk that determines the weakest direction of anchor `k`."""
        weakest = np.linalg.eigh(self.block(k)[:3, :3])[1][:, -1]
        places = np.concatenate(self.paths)
        if self.mirrored[k] or abs(weakest[2]) > 0.7:
            return "walk at two heights" if np.ptp(places[:, 2]) < 1.0 else f"walk at two heights near {self.names[k]}"
        offset = places - self.positions[k]
        radial = offset.mean(axis=0) / np.linalg.norm(offset.mean(axis=0))
        near = abs(weakest @ radial) > 0.7
        return f"walk close to {self.names[k]} and away from it" if near else f"walk around {self.names[k]}"

    def rows(self) -> list[list[str]]:
        """A row of `head` for each anchor; numbers that the walks do not determine in brackets."""
        rows = []
        for k, name in enumerate(self.names):
            over, height = self.determined(name)
            known = (over, over, height, bool(self.delay_determined[k]))
            values = np.append(self.positions[k], self.delays[k])
            cells = [_with_interval(*of) for of in zip(values, self.half_widths[k], known, strict=True)]
            rows.append([name, *cells, f"{100 * self.rms[k]:.1f}", str(self.readings[k]), self.verdict(name)])
        return rows

    @property
    def reading(self) -> str:
        """How to read the rows."""
        return (
            "± half the 95 % interval; in parentheses: not determined. As errors are correlated in time, intervals are "
            f"{self.effect**0.5:.1f} times as wide as with independent ones."
        )

    def __str__(self) -> str:
        rows = [list(self.head), *self.rows()]
        numbers = text_lines([row[:-1] for row in rows], "<" + ">" * (len(self.head) - 2))
        indent, lines = max(map(len, numbers)) + 2, [f"Anchors of {self.rig.name}", ""]
        if indent > WIDTH - 25:
            lines += [*numbers, "", *(f"{row[0]}: {row[-1]}" for row in rows[1:])]
        else:
            # Verdicts continue below themselves.
            for line, row in zip(numbers, rows, strict=True):
                first, *others = textwrap.wrap(row[-1], WIDTH - indent)
                lines += [f"{line:{indent}}{first}", *(" " * indent + other for other in others)]
        return "\n".join([*lines, "", *textwrap.wrap(self.reading, WIDTH)])

    def __repr__(self) -> str:
        return f"<Survey of {len(self.names)} anchors from {len(self.paths)} walks; print it for a table>"


def _with_interval(value: float, half_width: float, known: bool) -> str:
    """A number and half of its interval, in brackets where it is not determined."""
    if half_width == 0.0:
        return f"{value:z.3f}"
    if half_width > UNSEEN:
        return "–"
    text = f"{value:z.2f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{half_width:.2f}"
    return text if known else f"({text})"
