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

DELAY_DETERMINED = 0.7 * NORMAL * np.hypot(COMMON_DELAY, OWN_DELAY)
"""Half-width of the 95 % interval, m, with which ranges determine a delay better than what was known before."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Survey:
    """Anchors with their positions and delays. `names` (A,); `positions` (A, 3) m; `delays` (A,) m; `covariance` (4A,
    4A), m²: of x, y, z and delay of each anchor in turn, zero where the frame or exact values fix them. `mirrored`
    (A,): whether the mirror image of the anchor on the other side of the walk's plane fits as well. `rms`, m, and
    `readings` (A,): of errors. `effect`: by how much errors that last widen variances. `paths`: positions (n, 3), m, of
    the tag in each walk. `rig`: that of the first recording with these anchors, rounded to 0.1 mm. `notes`: what was
    assumed, a line each."""

    names: tuple[str, ...]
    positions: Float[np.ndarray, "A 3"]
    delays: Float[np.ndarray, " A"]
    covariance: Float[np.ndarray, "U U"]
    mirrored: Bool[np.ndarray, " A"]
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

    def verdict(self, name: str) -> str:
        """Whether an anchor is determined, and otherwise what walk would determine it; raises UnusableInput."""
        if name not in self.names:
            raise UnusableInput(f"{name!r}: no anchor of the survey; expected one of {listed(self.names, 12)}")
        k = self.names.index(name)
        what = ("x, y", "above or below the walk" if self.mirrored[k] else "height")
        unknown, weak = ([x for x, at in zip(what, self._extents(k), strict=True) if low < at <= high]
                         for low, high in ((WEAK, np.inf), (DETERMINED, WEAK)))  # fmt: skip
        words = "; ".join(f"{how}: {', '.join(of)}" for how, of in (("not determined", unknown), ("weak", weak)) if of)
        if not words:
            return "determined"
        # The walk that determines the weakest direction.
        weakest, places = np.linalg.eigh(self.block(k)[:3, :3])[1][:, -1], np.concatenate(self.paths)
        away = places.mean(axis=0) - self.positions[k]
        walk = f"walk around {name}"
        if self.mirrored[k] or abs(weakest[2]) > 0.7:
            walk = "walk at two heights" + (f" near {name}" if np.ptp(places[:, 2]) >= 1.0 else "")
        elif abs(weakest @ away) > 0.7 * np.linalg.norm(away):
            walk = f"walk close to {name} and away from it"
        return f"{words} ({walk})"

    def _extents(self, k: int) -> tuple[float, float]:
        """Half the largest horizontal axis of the 95 % interval of anchor `k`, and of its height, m."""
        flat = NORMAL * float(np.sqrt(np.linalg.eigvalsh(self.block(k)[:2, :2])[-1]))
        return flat, np.inf if self.mirrored[k] else float(self.half_widths[k, 2])

    def rows(self) -> list[list[str]]:
        """A row of `head` for each anchor; numbers that the walks do not determine in brackets."""
        rows, delays = [], self.half_widths[:, 3] < DELAY_DETERMINED
        for k, name in enumerate(self.names):
            over, height = (extent <= DETERMINED for extent in self._extents(k))
            known, values = (over, over, height, delays[k]), [*self.positions[k], self.delays[k]]
            cells = [_with_interval(*of) for of in zip(values, self.half_widths[k], known, strict=True)]
            rows.append([name, *cells, f"{100 * self.rms[k]:.1f}", str(self.readings[k]), self.verdict(name)])
        return rows

    @property
    def reading(self) -> str:
        """How to read the rows."""
        wide = f"intervals are {self.effect**0.5:.1f} times as wide as with independent ones."
        return f"± half the 95 % interval; in parentheses: not determined. As errors are correlated in time, {wide}"

    def __str__(self) -> str:
        rows = [list(self.head), *self.rows()]
        numbers = text_lines([row[:-1] for row in rows], "<" + ">" * (len(self.head) - 2))
        indent, lines = max(map(len, numbers)) + 2, [f"Anchors of {self.rig.name}", ""]
        for line, row in zip(numbers, rows, strict=True):
            begin, width = f"{line:{indent}}", max(WIDTH, indent + 25)
            lines += textwrap.wrap(row[-1], width, initial_indent=begin, subsequent_indent=" " * indent)
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
