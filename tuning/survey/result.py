"""What a survey found: positions and delays of anchors with intervals, verdicts, and their table."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

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

DETERMINED, WEAK = 0.25, 1.0
"""Half-widths of 95 % intervals, m, up to which a coordinate counts as determined, and as weakly so."""

UNSEEN = 100.0
"""Half-width of an interval, m, from which a number says nothing."""

HEAD = ("anchor", "x, m", "y, m", "z, m", "delay, m", "rms, cm", "ranges", "verdict")


@dataclass(frozen=True, eq=False)
class Survey:
    """Anchors with their positions and delays.

    `names` (A,); `positions` (A, 3) m and `delays` (A,) m; `covariance` (4A, 4A), m², of x, y, z and delay of each
    anchor in turn, zero where the frame or an exact position fixes a coordinate. `mirrored` (A,): whether the mirror
    image of the anchor on the other side of the walk's plane fits as well. `scales`, `rms`, m, and `readings` (A,): of
    each anchor's errors. `densities` (walks,): of the tags' accelerations, m²/s³. `effect`: by how much errors that
    last widen variances. `paths`: positions (n, 3), m, of the tag in each walk. `rig`: that of the first recording with
    these positions; `before`: as it was. `notes`: what was assumed, a line each.
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
    before: Rig
    notes: tuple[str, ...]

    @property
    def half_widths(self) -> Float[np.ndarray, "A 4"]:
        """Those of the 95 % intervals of x, y, z and delay of each anchor, m."""
        return NORMAL * np.sqrt(np.diag(self.covariance)).reshape(-1, 4)

    @property
    def delay_determined(self) -> Bool[np.ndarray, " A"]:
        """Whether the ranges determine a delay better than what was known before."""
        return self.half_widths[:, 3] < 0.7 * NORMAL * np.hypot(COMMON_DELAY, OWN_DELAY)

    def verdict(self, name: str) -> str:
        """Whether the position of an anchor is determined, and otherwise what walk would determine it."""
        k = self._number(name)
        flat, height = self._extents(k)
        third = (np.inf, "above or below the walk") if self.mirrored[k] else (height, "height")
        doubts: dict[str, list[str]] = {"not determined": [], "weak": []}
        for extent, what in ((flat, "x, y"), third):
            if extent > DETERMINED:
                doubts["not determined" if extent > WEAK else "weak"].append(what)
        words = [f"{how}: {', '.join(of)}" for how, of in doubts.items() if of]
        return f"{'; '.join(words)} ({self._advice(k)})" if words else "determined"

    def determined(self, name: str) -> tuple[bool, bool]:
        """Whether x and y, and whether the height of an anchor are determined."""
        k = self._number(name)
        flat, height = self._extents(k)
        return flat <= DETERMINED, height <= DETERMINED and not self.mirrored[k]

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise UnusableInput(f"{name!r}; expected an anchor of the survey; name one of {listed(self.names, 12)}")
        return self.names.index(name)

    def _extents(self, k: int) -> tuple[float, float]:
        """Half the largest horizontal axis of the 95 % interval of anchor `k`, and of its height, m."""
        block = self.covariance[4 * k : 4 * k + 3, 4 * k : 4 * k + 3]
        return NORMAL * float(np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1])), NORMAL * float(np.sqrt(block[2, 2]))

    def _advice(self, k: int) -> str:
        """The walk that determines the weakest direction of anchor `k`."""
        block = self.covariance[4 * k : 4 * k + 3, 4 * k : 4 * k + 3]
        weakest = np.linalg.eigh(block)[1][:, -1]
        places = np.concatenate(self.paths)
        if self.mirrored[k] or abs(weakest[2]) > 0.7:
            return "walk at two heights" if np.ptp(places[:, 2]) < 1.0 else f"walk at two heights near {self.names[k]}"
        offset = places - self.positions[k]
        radial = offset.mean(axis=0) / np.linalg.norm(offset.mean(axis=0))
        if abs(weakest @ radial) > 0.7:
            return f"walk close to {self.names[k]} and away from it"
        return f"walk around {self.names[k]}"

    def rows(self) -> list[list[str]]:
        """A row of `HEAD` for each anchor; numbers that the walks do not determine are in brackets."""
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
            "± half the 95 % interval; in brackets: not determined. As errors last, intervals are "
            f"{self.effect**0.5:.1f} times as wide as with independent ones."
        )

    def __str__(self) -> str:
        numbers = text_lines([row[:-1] for row in (HEAD, *self.rows())], "<" + ">" * (len(HEAD) - 2))
        indent = max(map(len, numbers)) + 2
        # Verdicts continue below themselves.
        verdicts = [textwrap.wrap(row[-1], max(WIDTH - indent, 25)) for row in (HEAD, *self.rows())]
        lines = [f"Anchors of {self.rig.name}", ""]
        for line, (first, *others) in zip(numbers, verdicts, strict=True):
            lines += [f"{line:{indent}}{first}", *(" " * indent + other for other in others)]
        return "\n".join([*lines, "", *textwrap.wrap(self.reading, WIDTH)])

    def __repr__(self) -> str:
        return f"<Survey of {len(self.names)} anchors from {len(self.paths)} walks; print it for a table>"


def _with_interval(value: float, half_width: float, known: bool) -> str:
    if half_width == 0.0:
        return f"{value:z.3f}"
    if half_width > UNSEEN:
        return "–"
    text = f"{value:z.2f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{half_width:.2f}"
    return text if known else f"({text})"
