"""The assembly line of the thesis: a cart on a known path in three situations, and fixes of its tag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.sim.corruptions import Corruption, corrupted, gauss_markov, white_noise
from trackwright.sim.keys import Keys, in_blocks, stream, trajectory_ids, trajectory_keys, uniforms
from trackwright.sim.tables import AXES, ArrayRows, folder_of
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.folder import RecordingFolder

THESIS_KNOTS = np.array([[2.615, 8.26], [6.665, 8.26], [6.665, 6.151], [2.615, 6.151], [2.615, 4.065], [6.665, 4.065]])
"""The corners of the path, m: Table 2.1 with the millimetres of equation (2.5)."""

TAG_HEIGHT = 0.78  # metres above the floor at which the cart carries its tag (section 2.5)

FIX_ERRORS: Mapping[str, Corruption] = MappingProxyType({"white": white_noise(0.22), "slow": gauss_markov(0.22, 1.5)})
"""A mean error of 0.39 m, as in Table 3.1, whose ratios white noise alone does not reproduce."""

Lengths = Float[np.ndarray, " k"]
Durations = Float[np.ndarray, "n k"]


def constant_speed(keys: Keys, lengths: Lengths, speed: float) -> tuple[Durations, Durations]:
    """Situation 1: the same speed on all segments, no halts."""
    travel = np.tile(lengths / speed, (len(keys), 1))
    return travel, np.zeros_like(travel)


def halts(keys: Keys, lengths: Lengths, speed: float) -> tuple[Durations, Durations]:
    """Situation 2: the same speed on all segments, and a halt of 5 s where two segments meet."""
    travel, rest = constant_speed(keys, lengths, speed)
    rest[:, :-1] = 5.0
    return travel, rest


def speed_changes(keys: Keys, lengths: Lengths, speed: float) -> tuple[Durations, Durations]:
    """Situation 3: a random speed on every segment, with a ratio of at most 4 between fastest and slowest, no halts.

    The whole path takes as long as at `speed`.
    """
    factors = 2.0 ** (2.0 * uniforms(stream(keys, "speeds"), (len(lengths),)).astype(float) - 1.0)
    travel = lengths / factors
    travel = travel * (lengths.sum() / speed / travel.sum(axis=1, keepdims=True))
    return travel, np.zeros_like(travel)


SITUATIONS = MappingProxyType({"constant": constant_speed, "halts": halts, "speeds": speed_changes})
"""The three situations of section 2.5: of keys, lengths and mean speed the travel time on each segment and the rest
after it, both (n, k), s."""


@dataclass(frozen=True)
class SimulatedLine:
    """Fixes of n tags at T times with their truth: m and s; `ids`: the trajectory ids."""

    times: Float[np.ndarray, " T"]
    arclength: Float[np.ndarray, "n T"]
    positions: Float[np.ndarray, "n T 2"]
    fixes: Float[np.ndarray, "n T 2"]
    seen: Bool[np.ndarray, "n T 2"]
    knots: Float[np.ndarray, "k 2"]
    ids: Int[np.ndarray, " n"]

    def folder(self, name: str) -> RecordingFolder:
        """The recording folder: fixes without height, truth at the tags' known height, the rig's path."""
        fixes = self.fixes if self.seen.all() else np.where(self.seen, self.fixes, np.nan)
        tables = {}
        for table, floor, height in (("fixes", fixes, np.nan), ("truth", self.positions, TAG_HEIGHT)):
            values = np.empty((*floor.shape[:2], 3))
            values[..., :2], values[..., 2] = floor, height
            tables[table] = ArrayRows.regular(self.times, self.ids, {AXES: values})
        tags = {str(i): Tag(height=TAG_HEIGHT) for i in self.ids}
        return folder_of(name, tables, tags, path_knots=self.knots)


def simulate_line(
    situation: str = "constant",
    n: int | Sequence[int] | np.ndarray = 1,
    seed: int = 0,
    *,
    knots: Float[np.ndarray, "k 2"] = THESIS_KNOTS,
    speed: float = 0.3,
    rest_s: float = 10.0,
    rate_hz: float = 5.0,
    errors: Mapping[str, Corruption] = FIX_ERRORS,
    carried_off: tuple[float, float, Sequence[float]] | None = None,
) -> SimulatedLine:
    """Tags that travel the path once, at rest for `rest_s` s before and after, with fixes at `rate_hz`.

    `n`: number of trajectories, or their ids. `errors`: corruptions of the fixes by name, in order. `carried_off`:
    start and end, s, of the time that the tag spends off the line, and its offset then, (dx, dy) m. The thesis prints
    neither speeds nor rate.
    """
    lengths = np.asarray(Polyline(knots).lengths)
    ids = trajectory_ids(n)
    keys = trajectory_keys(seed, ids)
    travel, rest = SITUATIONS[situation](keys, lengths, speed)
    legs = np.stack([travel, rest], axis=-1).reshape(len(ids), -1)
    ends = rest_s + np.concatenate([np.zeros((len(ids), 1)), np.cumsum(legs, axis=1)], axis=1)
    # In every situation all tags have the same duration, so that one tag does not depend on the others.
    times = np.arange(int(np.floor((ends[0, -1] + rest_s) * rate_hz)) + 1) / rate_hz
    marks = np.concatenate([[0.0], np.repeat(np.cumsum(lengths), 2)])
    corners = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(np.asarray(knots, float), axis=0) ** 2).sum(axis=1)))])

    def travelled(keys: Keys, ends: np.ndarray) -> tuple[np.ndarray, ...]:
        arclength = np.stack([np.interp(times, row, marks) for row in ends])
        positions = np.stack([np.interp(arclength, corners, axis) for axis in np.asarray(knots, float).T], axis=-1)
        if carried_off is not None:
            start, stop, offset = carried_off
            away = (times >= start) & (times < stop)
            positions = positions + np.where(away[:, None], np.asarray(offset, float), 0.0)
        return arclength, positions, *corrupted(errors, keys, times, positions, np.ones(positions.shape, bool))

    arclength, positions, fixes, seen = in_blocks(travelled, keys, ends)
    return SimulatedLine(times, arclength, positions, fixes, seen, np.asarray(knots, float), ids)
