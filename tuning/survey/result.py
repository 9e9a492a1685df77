"""What a survey found: positions of sensors with intervals, verdicts, and their table; of anchors, delays too."""

from __future__ import annotations

import textwrap
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.data.consistency import NORMAL
from trackwright.trackers.core.data.frames import text_lines
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.core.wording import WIDTH
from trackwright.trackers.recordings.calibration import RANGE_PRIOR
from trackwright.tuning.survey.frames import aligned

COMMON_DELAY, OWN_DELAY = RANGE_PRIOR[1][0], 0.1
"""Standard deviations of delays before any range, m: of what all anchors share, and of each anchor's own."""

DETERMINED, WEAK = 0.25, 1.0
"""Half-widths of 95 % intervals, m, up to which a coordinate counts as determined, and as weakly so."""

UNSEEN = 100.0
"""Half-width of an interval, m, from which a number says nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Survey(ABC):
    """Sensors, anchors or stations, with their positions and what else of them is estimated.

    `names` (S,); `positions` (S, 3) m; `covariance` (U, U): of the unknowns of each sensor in turn, zero where the
    frame or exact values fix them. `scales`, `rms` and `readings`: of errors. `densities` (walks,) or (walks, 3): of
    the tags' accelerations, m²/s³. `effect`: by how much errors that last widen variances. `paths`: positions (n, 3),
    m, of the tag in each walk. `rig`: that of the first recording with these sensors, rounded to 0.1 mm and 1e-6;
    `before`: as it was. `notes`: what was assumed, a line each.
    """

    names: tuple[str, ...]
    positions: Float[np.ndarray, "S 3"]
    covariance: Float[np.ndarray, "U U"]
    scales: Float[np.ndarray, " levels"]
    densities: Float[np.ndarray, "walks *axes"]
    rms: Float[np.ndarray, " levels"]
    readings: Int[np.ndarray, " levels"]
    effect: float
    paths: tuple[Float[np.ndarray, "_ 3"], ...]
    rig: Rig
    before: Rig
    notes: tuple[str, ...]

    noun: ClassVar[str]
    found: ClassVar[str]
    head: ClassVar[tuple[str, ...]]

    @property
    def half_widths(self) -> Float[np.ndarray, "S w"]:
        """Those of the 95 % intervals of the unknowns of each sensor."""
        return NORMAL * np.sqrt(np.diag(self.covariance)).reshape(len(self.names), -1)

    def block(self, k: int) -> Float[np.ndarray, "w w"]:
        """The covariance of the unknowns of sensor number `k`."""
        size = len(self.covariance) // len(self.names)
        return self.covariance[size * k : size * (k + 1), size * k : size * (k + 1)]

    @abstractmethod
    def before_onto(self) -> Float[np.ndarray, "k 3"]:
        """Where the rig had sensors, m, in the frame of the survey."""

    @abstractmethod
    def numbers(self, k: int) -> dict[str, Any]:
        """What is estimated of sensor `k`, with half-widths of 95 % intervals, by name and unit."""

    @abstractmethod
    def verdict(self, name: str) -> str:
        """Whether a sensor is determined, and otherwise what walk would determine it."""

    @abstractmethod
    def rows(self) -> list[list[str]]:
        """A row of `head` for each sensor, the verdict last; numbers that the walks do not determine in brackets."""

    @property
    def reading(self) -> str:
        """How to read the rows."""
        return (
            "± half the 95 % interval; in parentheses: not determined. As errors are correlated in time, intervals are "
            f"{self.effect**0.5:.1f} times as wide as with independent ones."
        )

    def __str__(self) -> str:
        numbers = text_lines([row[:-1] for row in (self.head, *self.rows())], "<" + ">" * (len(self.head) - 2))
        indent = max(map(len, numbers)) + 2
        lines = [f"{self.noun.capitalize()}s of {self.rig.name}", ""]
        if indent > WIDTH - 25:
            lines += [*numbers, "", *(f"{name}: {self.verdict(name)}" for name in self.names)]
        else:
            # Verdicts continue below themselves.
            verdicts = [textwrap.wrap(row[-1], WIDTH - indent) for row in (self.head, *self.rows())]
            for line, (first, *others) in zip(numbers, verdicts, strict=True):
                lines += [f"{line:{indent}}{first}", *(" " * indent + other for other in others)]
        return "\n".join([*lines, "", *textwrap.wrap(self.reading, WIDTH)])

    def __repr__(self) -> str:
        return f"<Survey of {len(self.names)} {self.noun}s from {len(self.paths)} walks; print it for a table>"

    def _number(self, name: str) -> int:
        if name not in self.names:
            expected = f"expected one of {listed(self.names, 12)}; correct its id"
            raise UnusableInput(f"{name!r}: no {self.noun} of the survey; {expected}")
        return self.names.index(name)

    def _worded(self, k: int, doubts: Sequence[tuple[float, str]]) -> str:
        """The verdict on sensor `k` by the extents of what is estimated, in units of those that are determined."""
        weak = [what for extent, what in doubts if 1.0 < extent <= WEAK / DETERMINED]
        unknown = [what for extent, what in doubts if not extent <= WEAK / DETERMINED]
        words = [f"{how}: {', '.join(of)}" for how, of in (("not determined", unknown), ("weak", weak)) if of]
        return f"{'; '.join(words)} ({self._advice(k)})" if words else "determined"

    @abstractmethod
    def _advice(self, k: int) -> str:
        """The walk that determines the weakest direction of sensor `k`."""

    def _extents(self, k: int) -> tuple[float, float]:
        """Half the largest horizontal axis of the 95 % interval of sensor `k`, and of its height, m."""
        block = self.block(k)
        return NORMAL * float(np.sqrt(np.linalg.eigvalsh(block[:2, :2])[-1])), NORMAL * float(np.sqrt(block[2, 2]))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class AnchorSurvey(Survey):
    """Anchors with their positions and delays.

    `delays` (A,) m; `covariance` (4A, 4A), m²: of x, y, z and delay of each anchor in turn. `mirrored` (A,): whether
    the mirror image of the anchor on the other side of the walk's plane fits as well. `scales`, `rms`, m, and
    `readings` (A,).
    """

    delays: Float[np.ndarray, " A"]
    mirrored: Bool[np.ndarray, " A"]

    noun, found = "anchor", "Positions and delays"
    head = ("anchor", "x, m", "y, m", "z, m", "delay, m", "rms, cm", "ranges", "verdict")

    def before_onto(self) -> Float[np.ndarray, "k 3"]:
        known = [k for k, name in enumerate(self.names) if name in self.before.anchors]
        if len(known) < 3:
            return np.zeros((0, 3))
        before = np.array([self.before.anchors[self.names[k]] for k in known])
        turn, shift = aligned(before, self.positions[known], 2)[0]
        return before @ turn.T + shift

    def numbers(self, k: int) -> dict[str, Any]:
        return {
            "position_m": self.positions[k], "half_width_m": self.half_widths[k, :3], "delay_m": self.delays[k],
            "delay_half_width_m": self.half_widths[k, 3], "delay_determined": self.delay_determined[k],
            "rms_m": self.rms[k], "ranges": self.readings[k],
        }  # fmt: skip

    @property
    def delay_determined(self) -> Bool[np.ndarray, " A"]:
        """Whether the ranges determine a delay better than what was known before."""
        return self.half_widths[:, 3] < 0.7 * NORMAL * np.hypot(COMMON_DELAY, OWN_DELAY)

    def verdict(self, name: str) -> str:
        k = self._number(name)
        flat, height = self._extents(k)
        third = (np.inf, "above or below the walk") if self.mirrored[k] else (height, "height")
        return self._worded(k, [(flat / DETERMINED, "x, y"), (third[0] / DETERMINED, third[1])])

    def determined(self, name: str) -> tuple[bool, bool]:
        """Whether x and y, and whether the height of an anchor are determined."""
        k = self._number(name)
        flat, height = self._extents(k)
        return flat <= DETERMINED, height <= DETERMINED and not self.mirrored[k]

    def _advice(self, k: int) -> str:
        weakest = np.linalg.eigh(self.block(k)[:3, :3])[1][:, -1]
        places = np.concatenate(self.paths)
        if self.mirrored[k] or abs(weakest[2]) > 0.7:
            return "walk at two heights" if np.ptp(places[:, 2]) < 1.0 else f"walk at two heights near {self.names[k]}"
        offset = places - self.positions[k]
        radial = offset.mean(axis=0) / np.linalg.norm(offset.mean(axis=0))
        if abs(weakest @ radial) > 0.7:
            return f"walk close to {self.names[k]} and away from it"
        return f"walk around {self.names[k]}"

    def rows(self) -> list[list[str]]:
        rows = []
        for k, name in enumerate(self.names):
            over, height = self.determined(name)
            known = (over, over, height, bool(self.delay_determined[k]))
            values = np.append(self.positions[k], self.delays[k])
            cells = [with_interval(*of) for of in zip(values, self.half_widths[k], known, strict=True)]
            rows.append([name, *cells, f"{100 * self.rms[k]:.1f}", str(self.readings[k]), self.verdict(name)])
        return rows


def with_interval(value: float, half_width: float, known: bool) -> str:
    """A number and half of its interval, in brackets where it is not determined."""
    if half_width == 0.0:
        return f"{value:z.3f}"
    if half_width > UNSEEN:
        return "–"
    text = f"{value:z.2f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{half_width:.2f}"
    return text if known else f"({text})"
