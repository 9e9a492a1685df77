"""Where recent ranges meet, for every row at once on the host: the start of trackers that read ranges."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from trackers.parts.multilaterate import multilaterate

LATEST = 5
"""Ranges of one anchor whose median counts: two wild ones among them do no harm."""

SURE = 0.3
"""Metres of misfit from which a range loses its say."""

MAX_BATCH = 256, 4096
"""Rows whose places are searched for at once, in a short recording and in a long one: two compiled programs in all."""


def recent_places(
    times: np.ndarray,
    anchors: np.ndarray,
    numbers: np.ndarray,
    ranges: np.ndarray,
    seen: np.ndarray,
    height: float | None,
    windows: tuple[float, ...] = (1.0, 5.0),
) -> np.ndarray:
    """For every row (T, 4): the place where the ranges of the last seconds meet, m, and 1 where they determine it.

    `times` (T,) s, sorted; `anchors` (A, 3) m; `numbers` (T,) of each row's anchor; `ranges` (T,) m and `seen` (T,).
    With a known `height` the place has it, and three anchors are needed; without, four. The second of the `windows`,
    s, is used where the first doesn't hold enough.
    """
    result = np.zeros((len(times), 4))
    for window in windows:
        open_rows = np.flatnonzero(result[:, 3] == 0)
        if len(open_rows) == 0:
            break
        middles, fresh = _medians(times, len(anchors), numbers, ranges, seen, window)
        result[open_rows] = _places(anchors, middles[open_rows], fresh[open_rows], height)
    return result


def _medians(
    times: np.ndarray, count: int, numbers: np.ndarray, ranges: np.ndarray, seen: np.ndarray, window: float
) -> tuple[np.ndarray, np.ndarray]:
    """Per row and anchor (T, A): the median of its latest ranges in the window, and whether there is one."""
    middles, fresh = np.zeros((len(times), count)), np.zeros((len(times), count), bool)
    for k in range(count):
        mine = np.flatnonzero((numbers == k) & seen)
        if len(mine) == 0:
            continue
        own_times, own = times[mine], ranges[mine]
        back = np.arange(len(mine))[:, None] - np.arange(LATEST)
        recent = (back >= 0) & (own_times[:, None] - own_times[np.maximum(back, 0)] <= window)
        medians = np.nanmedian(np.where(recent, own[np.maximum(back, 0)], np.nan), axis=1)
        # The rows up to and with this one, not those that come after it at the same time.
        last = np.searchsorted(mine, np.arange(len(times)), side="right") - 1
        fresh[:, k] = (last >= 0) & (times - own_times[np.maximum(last, 0)] <= window)
        middles[:, k] = medians[np.maximum(last, 0)]
    return middles, fresh


def _places(anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, height: float | None) -> np.ndarray:
    """The place (T, 4) of each row of ranges (T, A) to the anchors that count (T, A); see `recent_places`."""
    result = np.zeros((len(ranges), 4))
    at = None if height is None else jnp.asarray(height, float)
    together = MAX_BATCH[0] if len(ranges) <= 4 * MAX_BATCH[0] else MAX_BATCH[1]
    for first in range(0, len(ranges), together):
        rows = len(ranges[first : first + together])
        own, heard = (np.pad(x[first : first + rows], ((0, together - rows), (0, 0))) for x in (ranges, counts))
        found = _searched(jnp.asarray(anchors, float), jnp.asarray(own, float), heard, at)
        place, determined = (np.asarray(x)[:rows] for x in found)
        if height is not None:
            place = np.column_stack([place, np.full(rows, height)])
        result[first : first + rows] = np.column_stack([np.where(determined[:, None], place, 0.0), determined])
    return result


@jax.jit
def _searched(anchors: Any, ranges: Any, counts: Any, height: Any) -> tuple[Any, Any]:
    scale = jnp.asarray(SURE, ranges.dtype)
    place = jax.vmap(lambda r, c: multilaterate(r, anchors, c, height, scale))(ranges, counts)
    return place.position, place.determined
