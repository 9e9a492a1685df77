"""What has changed: the causes that explain the readings since the alarm, each fitted, and compared with each other.

The fit is linear in the scores at first, with the onset that explains most. Large changes, and swaps, which are large
always, are fitted to the readings themselves: a cause is undone in them, positions follow, and scores are computed
anew, until they are zero (Gauss and Newton). Causes are compared by their log-likelihood, tempered by the scatter of
normal operation, less half the logarithm of the number of blocks for each number fitted (Schwarz 1978).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.recordings.checks.fitted_changes import about_vertical
from trackwright.trackers.recordings.kinds import wrapped
from trackwright.tuning.watch.normal import Normal, place_numbers, scatter_of
from trackwright.tuning.watch.parity import LOST, Blocks, blocks_of, doubled, located
from trackwright.tuning.watch.readings import SLOT_S, Readings, Source, merged, with_weights

BEFORE, AFTER = 24, 60
"""Slots before the onset of an alarm, and after it, to which causes are fitted."""

LARGE_M, LARGE_RAD = 0.3, np.radians(8.0)
"""Sizes from which a cause is fitted to the readings themselves."""

SWAPPED_M, SWAPPED_SLOTS = 0.4, 8
"""Size from which swaps are tried, and slots after the alarm on which they are."""

STEPS, CLOSEST = 4, 6
"""Steps of a fit to the readings, and the causes that are fitted so."""

LITTLE = 1e-3
"""Information that every size has, per squared unit, so that it can be inverted."""

WORDS = {
    "moved": "has moved", "delay": "has another delay", "drift": "has a clock that drifts", "turned": "has turned",
    "wall": "is obstructed at some places", "swapped": "have been swapped",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Cause:
    """A change of sources from a slot on.

    `name`: one of `WORDS`. `sources`: one, or the two that are swapped. `unit` (P, K): parameters of unit sizes;
    `size` (K,), m or rad, of a drift per second; `covariance` (K, K), and by how much scores
    about it scatter more than their information says, `scatter` (K,). `places`: numbers of those that it
    concerns alone, None for all. `gain`: of the tempered log-likelihood; `penalty`: of what was fitted.
    """

    name: str
    sources: tuple[Source, ...]
    unit: Float[np.ndarray, "P K"]
    onset: int
    size: Float[np.ndarray, " K"]
    covariance: Float[np.ndarray, "K K"]
    scatter: Float[np.ndarray, " K"]
    places: Int[np.ndarray, " p"] | None = None
    gain: float = -np.inf
    penalty: float = 0.0

    @property
    def score(self) -> float:
        """The gain less the penalty."""
        return self.gain - self.penalty

    @property
    def large(self) -> bool:
        """Whether scores about no change are not to be trusted."""
        limit = LARGE_RAD if self.name in ("turned", "wall") and self.sources[0].table == "bearings" else LARGE_M
        size = np.abs(self.size).max(initial=0.0)
        return bool((size * SLOT_S * AFTER if self.name == "drift" else size) > limit)

    def factor(self, slot: np.ndarray, place: np.ndarray, times: np.ndarray | None = None) -> np.ndarray:
        """By how much its size acts in slots, at places; `times`, s, by default those of the middle of the slots."""
        acts = (slot >= self.onset) & (True if self.places is None else np.isin(place, self.places))
        times = SLOT_S * (slot + 0.5) if times is None else times
        return acts * (times - SLOT_S * self.onset if self.name == "drift" else 1.0)


def likely_causes(
    readings: Mapping[str, Readings],
    blocks: Blocks,
    sources: Sequence[Source],
    normal: Normal,
    onset: int,
    alarm: int,
    again: tuple[float, float],
    scales: Mapping[tuple[str, str], np.ndarray],
) -> list[Cause]:
    """The causes of an alarm by their scores, the best first; `onset`, `alarm`: slots of the rise and of the alarm.

    `blocks`: corrected ones; `again`: the width of windows and the size of places of `blocks_of`; `scales`: of errors.
    """
    near = (blocks.slot >= onset - BEFORE) & (blocks.slot < onset + AFTER)
    blocks = blocks.chosen(near)
    place = normal.place_of(blocks)
    causes = sorted(_linear(blocks, place, sources, normal, onset), key=lambda cause: -cause.score)
    closest = causes[:CLOSEST]
    if not any(cause.large for cause in closest[:2]):
        return closest
    kept = {t: r.of_rows(_between(r, onset - BEFORE, onset + AFTER)) for t, r in readings.items()}
    few = merged(kept, again[0])
    before = normal.corrected(blocks_of(few, sources, *again, LOST))
    start = float(before.energy.sum())
    fitted = [_fitted(cause, few, sources, normal, again, start) for cause in closest]
    if any(np.abs(cause.size).max() > SWAPPED_M for cause in closest[:2] if cause.name != "drift"):
        fitted += _swaps(few, sources, normal, alarm, again, before)
    best, *others = sorted(fitted, key=lambda cause: -cause.score)
    return [_reweighted(best, kept, sources, normal, again, scales), *others]


def _reweighted(
    cause: Cause, readings: Mapping[str, Readings], sources: Sequence[Source], normal: Normal,
    again: tuple[float, float], scales: Mapping[tuple[str, str], np.ndarray],
) -> Cause:  # fmt: skip
    """The cause fitted with weights as without it: those under a change that varies draw it to its median.

    An obstruction hides a part of its places: its readings there all count alike, so that its size is their mean.
    """
    if not len(cause.size):
        return cause
    without = located(undone(readings, cause, normal, again[1]), sources, again[0])
    weights = {table: each.weights for table, each in with_weights(without, scales)[0].items()}
    if cause.name == "wall":
        source = cause.sources[0]
        each, known = readings[source.table], weights[source.table] > 0.0
        acts = (_factor(cause, each, normal, again[1]) * _signs(source, each))[:, None] != 0.0
        weights[source.table] = np.where(acts & known, scales[source.table, source.name] ** -2, weights[source.table])
    weighted = {table: replace(each, weights=weights[table]) for table, each in readings.items()}
    few = merged(weighted, again[0])
    return replace(_fitted(replace(cause, gain=-np.inf), few, sources, normal, again, 0.0), gain=cause.gain)


def _between(each: Readings, first: int, last: int) -> np.ndarray:
    return (each.times >= first * SLOT_S) & (each.times < last * SLOT_S)


def _linear(
    blocks: Blocks, place: np.ndarray, sources: Sequence[Source], normal: Normal, onset: int
) -> Iterator[Cause]:
    """The causes of one source each, fitted to scores."""
    tempered = float(np.median(normal.scatter))
    count = blocks.score.shape[1]
    for source in sources:
        own = np.eye(count)[:, source.first : source.first + len(source.parameters)]
        of_station = source.table == "bearings"
        shapes = [("turned", [0]), ("turned", [0, 1]), ("moved", [2, 3, 4])] if of_station else []
        shapes = shapes or [("delay", [0]), ("moved", [1, 2]), ("moved", [1, 2, 3]), ("drift", [0])]
        for name, columns in shapes:
            nothing = np.zeros(len(columns))
            cause = Cause(name, (source,), own[:, columns], onset, nothing, np.diag(nothing), nothing)
            yield _with_best_onset(cause, blocks, place, tempered)
        yield from _walls(source, own[:, [0, 1] if of_station else [0]], blocks, place, onset, tempered)


def _sums(cause: Cause, blocks: Blocks, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The score (B, K) and the information (B, K, K) of each block about the size of a cause."""
    factor = cause.factor(blocks.slot, place)
    score = factor[:, None] * (blocks.score @ cause.unit)
    information = np.einsum("bij,ik,jl->bkl", blocks.information, cause.unit, cause.unit, optimize=True)
    return score, factor[:, None, None] ** 2 * information


def _with_best_onset(cause: Cause, blocks: Blocks, place: np.ndarray, tempered: float) -> Cause:
    """The cause with the onset and the size that explain most, and its gain."""
    best = cause
    for slot in np.unique(blocks.slot)[:-1]:
        moved = replace(cause, onset=int(slot))
        score, information = (x.sum(axis=0) for x in _sums(moved, blocks, place))
        information = information + LITTLE * np.eye(len(score))
        size = np.linalg.solve(information, score)
        gain = 0.5 * float(score @ size) / tempered
        if gain > best.gain:
            best = replace(moved, size=size, gain=gain)
    penalty = 0.5 * cause.unit.shape[1] * np.log(max((blocks.slot >= best.onset).sum(), 2))
    score, information = _sums(best, blocks, place)
    scatter, covariance = _scatter(score, information, best.size), _covariance(best, blocks, information)
    return replace(best, penalty=cause.penalty + penalty, scatter=scatter, covariance=covariance)


def _covariance(cause: Cause, blocks: Blocks, information: np.ndarray) -> np.ndarray:
    """The inverse of the information (B, K, K) on the size; of a drift beside a constant, as its onset is not known."""
    total = information.sum(axis=0)
    if cause.name != "drift":
        return np.linalg.inv(total + LITTLE * np.eye(len(total)))
    times = SLOT_S * (blocks.slot + 0.5 - cause.onset)
    own = np.where(
        times > 0.0, np.einsum("bij,ik,jk->b", blocks.information, cause.unit, cause.unit, optimize=True), 0.0
    )
    both = np.array([[(own * times**2).sum(), (own * times).sum()], [(own * times).sum(), own.sum()]])
    return np.linalg.inv(both + LITTLE * np.eye(2))[:1, :1]


def _scatter(score: np.ndarray, information: np.ndarray, size: np.ndarray) -> np.ndarray:
    """By how much the scores (B, K) of blocks that a cause acts on scatter about its size, relative to information."""
    acts = np.einsum("bkk->b", information) > 0.0
    return scatter_of(score[acts] - information[acts] @ size, information[acts])


def _walls(
    source: Source, unit: np.ndarray, blocks: Blocks, place: np.ndarray, onset: int, tempered: float
) -> Iterator[Cause]:
    """The cause of a constant error at some of the places: of all sets of places the best is one of the largest."""
    count = unit.shape[1]
    none = Cause("wall", (source,), unit, onset, np.zeros(count), np.zeros((count, count)), np.ones(count))
    score, information = _sums(none, blocks, place)
    seen = np.unique(place[blocks.slot >= onset])
    if len(seen) < 2:
        return
    g = np.array([score[place == k].sum(axis=0) for k in seen])
    F = np.array([information[place == k].sum(axis=0) for k in seen]) + 1e-6 * np.eye(count)
    # The direction of the error, of a station in both angles, is that of the place that says most.
    own = np.linalg.solve(F, g[..., None])[..., 0]
    along = own[np.argmax((own * g).sum(axis=1))]
    along = np.abs(along) if source.table == "ranges" else along
    slope, curvature = g @ along, np.einsum("i,kij,j->k", along, F, along)
    order = np.argsort(-slope / curvature)
    so_far = np.cumsum(np.stack([slope, curvature])[:, order], axis=1)[:, :-1]
    gains = np.where(so_far[0] > 0, so_far[0] ** 2 / so_far[1], 0.0)
    chosen = np.sort(seen[order[: int(np.argmax(gains)) + 1]])
    yield _with_best_onset(replace(none, places=chosen, penalty=len(seen) * np.log(2.0)), blocks, place, tempered)


def _fitted(
    cause: Cause, readings: Mapping[str, Readings], sources: Sequence[Source], normal: Normal,
    again: tuple[float, float], start: float,
) -> Cause:  # fmt: skip
    """The cause fitted to the readings themselves; `start`: their energy without any."""
    best = replace(cause, gain=-np.inf)
    for step in range(STEPS + 1):
        blocks = normal.corrected(blocks_of(undone(readings, cause, normal, again[1]), sources, *again, LOST))
        place = normal.place_of(blocks)
        of_blocks = _sums(cause, blocks, place)
        score, information = (x.sum(axis=0) for x in of_blocks)
        information = information + LITTLE * np.eye(len(score))
        gain = 0.5 * float(start - blocks.energy.sum()) / float(np.median(normal.scatter))
        if gain > best.gain:
            scatter = _scatter(*of_blocks, np.zeros(len(score)))
            best = replace(cause, gain=gain, covariance=_covariance(cause, blocks, of_blocks[1]), scatter=scatter)
        change = np.linalg.solve(information, score)
        if step == STEPS or not len(change) or np.abs(change).max() < 1e-3:
            break
        cause = replace(cause, size=cause.size + change)
    return best


def _swaps(
    readings: Mapping[str, Readings], sources: Sequence[Source], normal: Normal, alarm: int,
    again: tuple[float, float], before: Blocks,
) -> Iterator[Cause]:  # fmt: skip
    """The swaps of two sources of a kind that explain most of the slots after the alarm; `before`: without any."""
    last_slot = min(alarm + SWAPPED_SLOTS, int(before.slot.max()) + 1)
    first_slot = min(alarm, last_slot - SWAPPED_SLOTS // 2)
    first = {t: r.of_rows(_between(r, first_slot, last_slot)) for t, r in readings.items()}
    first = {t: r for t, r in first.items() if len(r.times)}
    empty = np.zeros((normal.scatter.size, 0))
    pairs = [pair for pair in combinations(sources, 2) if pair[0].table == pair[1].table]
    swaps = [Cause("swapped", pair, empty, first_slot, np.zeros(0), np.zeros((0, 0)), np.zeros(0)) for pair in pairs]
    tried = [_fitted(cause, first, sources, normal, again, 0.0) for cause in swaps]
    for cause in sorted(tried, key=lambda cause: -cause.gain)[:2]:
        always = undone(readings, replace(cause, onset=int(before.slot.min())), normal, again[1])
        after = normal.corrected(blocks_of(always, sources, *again, LOST))
        slots, number = np.unique(before.slot, return_inverse=True)
        less = np.bincount(number, before.energy) - np.bincount(np.searchsorted(slots, after.slot), after.energy)
        since = int(slots[np.argmax(np.cumsum(less[::-1])[::-1])])
        yield _fitted(replace(cause, onset=since, gain=-np.inf), readings, sources, normal, again, before.energy.sum())


def _factor(cause: Cause, each: Readings, normal: Normal, cell_m: float) -> np.ndarray:
    """By how much the size of a cause acts at the time and the place of each reading (N,)."""
    place = place_numbers(np.floor(each.positions[:, :2] / cell_m).astype(int), normal.places)
    return cause.factor(np.floor(each.times / SLOT_S), place, each.times)


def _signs(source: Source, each: Readings) -> np.ndarray:
    """With which sign each reading (N,) has the distance to a source, 0 for none."""
    mine = (each.measured.sensors.number == each.measured.ids.index(source.name)).astype(float)
    return mine[:, 0] - (mine[:, 1] if mine.shape[1] > 1 else 0.0)


def undone(readings: Mapping[str, Readings], cause: Cause, normal: Normal, cell_m: float) -> dict[str, Readings]:
    """The readings as they would be without a cause."""
    table = cause.sources[0].table
    if table not in readings:
        return dict(readings)
    each = readings[table]
    measured, sensors = each.measured, each.measured.sensors
    factor = _factor(cause, each, normal, cell_m)
    ids = [measured.ids.index(source.name) for source in cause.sources]
    acts = factor != 0.0
    if cause.name == "swapped":
        exchanged = np.arange(len(measured.ids))
        exchanged[ids] = exchanged[ids[::-1]]
        sensors = sensors._replace(number=np.where(acts[:, None], exchanged[sensors.number], sensors.number))
        return {**readings, table: replace(each, measured=measured._replace(sensors=sensors))}
    of = dict(zip(cause.sources[0].parameters, (cause.unit @ cause.size)[cause.sources[0].first :], strict=False))
    constant = factor * _signs(cause.sources[0], each)
    values = measured.values.copy()
    if table == "bearings":
        values[:, 1] -= of["tilt"] * constant
    else:
        values[:, 0] -= of["delay"] * constant
    places, axes = sensors.places.copy(), sensors.axes.copy()
    places[ids[0]] += [of["x"], of["y"], of["z"]]
    axes[ids[0]] = about_vertical(of.get("turn", 0.0)) @ axes[ids[0]]
    both = doubled(sensors, places, axes)._replace(number=sensors.number + len(sensors.places) * acts[:, None])
    values = wrapped(values, measured.columns)
    twice = measured._replace(ids=measured.ids * 2, values=values, sensors=both)
    return {**readings, table: replace(each, measured=twice)}
