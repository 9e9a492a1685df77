"""Where recent ranges meet, for every row at once on the host: the start of trackers that read ranges."""

from __future__ import annotations

import numpy as np

LATEST = 5
"""Ranges of one anchor whose median counts: two wild ones among them do no harm."""

FLAT = 0.02
"""Least information of the worst-seen horizontal direction per range, 0 … 1/2, with which a place is determined."""

SURE = 0.3
"""Metres of misfit from which a range loses its say."""

ROUNDS = 15
"""Steps of the least-squares search; from anywhere between the anchors ten reach a millimetre."""


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
    n = 3 if height is None else 2
    middle = anchors.mean(axis=0)
    apart = np.array([0.0, 0.0, np.linalg.norm(anchors[:, :2].std(axis=0))])
    starts = [middle - apart, middle + apart] if height is None else [np.append(middle[:2], height)]
    found = [_descent(anchors, ranges, counts, np.tile(start, (len(ranges), 1)), n) for start in starts]
    costs = np.stack([cost for _, cost, _ in found])
    # Anchors in one plane leave two mirror images; the one with the smaller misfit it is.
    best = np.argmin(costs, axis=0)
    rows = np.arange(len(ranges))
    places = np.stack([place for place, _, _ in found])[best, rows]
    worst = np.stack([w for _, _, w in found])[best, rows]
    determined = (worst > FLAT) & (counts.sum(axis=1) > n) & np.isfinite(places).all(axis=1)
    return np.concatenate([np.where(determined[:, None], places, 0.0), determined[:, None]], axis=1)


def _descent(
    anchors: np.ndarray, ranges: np.ndarray, counts: np.ndarray, places: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss–Newton with weights that forget wild ranges: places, misfits, least horizontal information per range."""
    many = np.maximum(counts.sum(axis=1), 1)
    for last in range(ROUNDS + 1):
        away = places[:, None, :] - anchors
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
        misfit = np.where(counts, ranges - distance, 0.0)
        typical = (
            np.nanmedian(np.where(counts, np.abs(misfit), np.nan), axis=1) if counts.any() else np.zeros(len(many))
        )
        scale = np.maximum(np.nan_to_num(typical) * 1.5, SURE)[:, None]
        slope = away[:, :, :n] / distance[:, :, None]
        if last == ROUNDS:
            break
        weight = counts / (1.0 + (misfit / scale) ** 2)
        information = np.einsum("ta,tai,taj->tij", weight, slope, slope) + 1e-3 * np.eye(n)
        step = np.linalg.solve(information, np.einsum("ta,ta,tai->ti", weight, misfit, slope)[:, :, None])[:, :, 0]
        longest = np.maximum(np.linalg.norm(step, axis=1, keepdims=True) / distance.mean(axis=1, keepdims=True), 1.0)
        places = places + np.pad(step / longest, ((0, 0), (0, 3 - n)))
    cost = np.sum(np.log1p((misfit / SURE) ** 2), axis=1)
    flat = slope[:, :, :2]
    gram = np.einsum("ta,tai,taj->tij", counts.astype(float), flat, flat) / many[:, None, None]
    return places, cost, np.linalg.eigvalsh(gram)[:, 0]
