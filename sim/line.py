"""The assembly line of the thesis: a cart on a known path in three situations, and fixes of its tag."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from trackwright.sim.corruptions import Corruption, corrupted, gauss_markov, white_noise
from trackwright.sim.keys import Keys, namespace, repeated, stream, trajectory_keys, uniforms
from trackwright.sim.tables import AXES, AbstractDraw, ArrayRows, SimulatedWorld, by_name, static
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.rig import Tag
from trackwright.trackers.recordings.folder import RecordingFolder

THESIS_KNOTS = np.array([[2.615, 8.26], [6.665, 8.26], [6.665, 6.151], [2.615, 6.151], [2.615, 4.065], [6.665, 4.065]])
"""The corners of the path, m: Table 2.1 with the millimetres of equation (2.5)."""

TAG_HEIGHT = 0.78  # metres above the floor at which the cart carries its tag (section 2.5)

FIX_ERRORS: Mapping[str, Corruption] = MappingProxyType({"white": white_noise(0.22), "slow": gauss_markov(0.22, 1.5)})
"""A mean error of 0.39 m, as in Table 3.1, whose ratios white noise alone does not reproduce."""

Durations = tuple[Float[Any, "_ k"], Float[Any, "_ k"]]  # travel and rest, of each trajectory, or of one for all


def durations(situation: str, keys: Keys, lengths: Float[np.ndarray, " k"], speed: float) -> Durations:
    """The travel time on each segment and the rest after it, both (n, k), or (1, k) for all, s, as in section 2.5.

    Situation 1, `constant`: the same speed on all segments, no halts. 2, `halts`: and a halt of 5 s where two segments
    meet. 3, `speeds`: a random speed on every segment, with a ratio of at most 4 between fastest and slowest, no halts;
    the whole path takes as long as at `speed`.
    """
    travel = lengths[None] / speed
    if situation == "speeds":
        factors = 2.0 ** (2.0 * uniforms(stream(keys, "speeds"), (len(lengths),)).astype(float) - 1.0)
        travel = lengths / factors
        travel = travel * (lengths.sum() / speed / travel.sum(axis=1, keepdims=True))
    rest = np.zeros(travel.shape)
    rest[:, :-1] = {"constant": 0.0, "halts": 5.0, "speeds": 0.0}[situation]
    return travel, rest


def piecewise_linear(x: Any, knots: Any, values: Float[np.ndarray, " k"]) -> Any:
    """The values at x, linear between rising knots (k, …) and constant beyond them; as ramps, without a search."""
    ramps = (
        rise * namespace(x, width).clip((x - knot) / namespace(width).where(width > 0, width, 1.0), 0.0, 1.0)
        for knot, width, rise in zip(knots, knots[1:] - knots[:-1], np.diff(values), strict=False)
        if rise
    )
    return values[0] + sum(ramps)


class LineDraw(AbstractDraw):
    """Tags that travel the path once, at rest for `rest_s` s before and after, with fixes at `rate_hz`.

    `situation`: as in `durations`. `errors`: corruptions of the fixes by name, in order. `knots`: the corners (x, y) of
    the path, m. Its arrays: `arclength` (n, T) m; `positions`, `fixes` (n, T, 2) m, where `seen`. The thesis prints
    neither speeds nor rate.
    """

    situation: Literal["constant", "halts", "speeds"] = static(default="constant")
    errors: Mapping[str, Corruption] = by_name(default_factory=lambda: FIX_ERRORS)
    knots: tuple[tuple[float, ...], ...] = static(default=tuple(map(tuple, THESIS_KNOTS.tolist())))
    speed: float = static(default=0.3)
    rest_s: float = static(default=10.0)
    rate_hz: float = static(default=5.0)

    measured = MappingProxyType({"fixes": "seen"})

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        # In every situation all tags have the same duration, so that one tag does not depend on the others.
        with jax.ensure_compile_time_eval():
            end = self._ends(trajectory_keys(0, [0]))[0, -1]
        return np.arange(int(np.floor((end + self.rest_s) * self.rate_hz)) + 1) / self.rate_hz

    def _ends(self, keys: Keys) -> Float[Any, "_ legs"]:
        """The times, s, at which the tags' first rest, and each travel and rest after it, ends."""
        lengths = np.asarray(Polyline(np.array(self.knots)).lengths)
        travel, rest = durations(self.situation, keys, lengths, self.speed)
        xp = namespace(travel)
        legs = xp.stack([travel, rest], axis=-1).reshape(len(travel), -1)
        return self.rest_s + xp.concatenate([np.zeros((len(legs), 1)), xp.cumsum(legs, axis=1)], axis=1)

    def arrays(self, keys: Keys) -> dict[str, Any]:
        times, knots, ends = self.times, np.array(self.knots), self._ends(keys)
        lengths = np.sqrt((np.diff(knots, axis=0) ** 2).sum(axis=1))
        corners, xp = np.concatenate([[0.0], np.cumsum(lengths)]), namespace(ends)
        arclength = piecewise_linear(times, ends.T[..., None], np.repeat(corners, 2)[1:])
        positions = xp.stack([piecewise_linear(arclength, corners, axis) for axis in knots.T], axis=-1)
        if len(ends) == 1:
            arclength, positions = repeated(arclength, keys), repeated(positions, keys)
        fixes, seen = corrupted(self.errors, keys, times, positions)
        return {"arclength": arclength, "positions": positions, "fixes": fixes, "seen": seen}

    def folder(self, world: SimulatedWorld) -> RecordingFolder:
        """Fixes without height, truth at the tags' known height, the rig's path."""
        fixes, tables = np.where(world.seen, world.arrays["fixes"], np.nan), {}
        for table, floor, height in (("fixes", fixes, np.nan), ("truth", world.positions, TAG_HEIGHT)):
            values = np.concatenate([floor, np.full_like(floor[..., :1], height)], axis=-1)
            tables[table] = ArrayRows(world.times, world.ids, {AXES: values})
        tags = {str(i): Tag(height=TAG_HEIGHT) for i in world.ids}
        return world.recorded(tables, tags, path_knots=np.array(self.knots))
