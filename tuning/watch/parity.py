"""Scores of anchors and stations from readings, with the positions eliminated.

A tracked position is wrong where an anchor has moved, the more so the better the tracker explains the readings. So the
readings of one tag within a short window have an unknown shift of the tracked position in common, which is projected
out of them. What is left (the parity vector of Potter and Suman 1977) depends on no position, to first order, and on no
tracker. Of it we keep scores and informations of all parameters of anchors and stations, which add over windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from trackwright.trackers.recordings.checks.fitted_changes import about_vertical
from trackwright.trackers.recordings.kinds import Sensors, wrapped
from trackwright.tuning.watch.readings import OF_ANCHOR, OF_STATION, SLOT_S, Readings, Source

TRACKED, LOST = (1.0, 1), (5.0, 5)
"""Standard deviation of a tracked position before the readings of its window, m, and how often it is corrected: as a
tracker has it, and where a large change has misled the tracker."""

_STEP, _ROWS, _LEVEL = 1e-4, 100_000, 1e6


class Blocks(NamedTuple):
    """Scores and informations of parameters, summed over the windows of a tag that are in one slot and one place.

    `track`, `slot` and `cell` (B,); `score` (B, P) and `information` (B, P, P); `energy` (B,): the weighted squares
    that positions leave.
    """

    track: Int[np.ndarray, " B"]
    slot: Int[np.ndarray, " B"]
    cell: Int[np.ndarray, "B 2"]
    score: Float[np.ndarray, "B P"]
    information: Float[np.ndarray, "B P P"]
    energy: Float[np.ndarray, " B"]

    def chosen(self, part: np.ndarray) -> Blocks:
        """Some of them."""
        return Blocks(*(column[part] for column in self))


class Rows(NamedTuple):
    """Values, one a row: errors and weights (n,), derivatives by position (n, 3), and by some parameters (n, q)."""

    errors: np.ndarray
    weights: np.ndarray
    by_position: np.ndarray
    parameters: np.ndarray
    by_parameter: np.ndarray

    def by_all(self, count: int) -> np.ndarray:
        """The derivatives (n, P) by all parameters."""
        result = np.zeros((len(self.errors), count))
        rows = np.arange(len(result))
        for number, derivative in zip(self.parameters.T, self.by_parameter.T, strict=True):
            result[rows, number] += derivative
        return result


def linearised(each: Readings, sources: Sequence[Source], parameters: bool = True) -> Rows:
    """The values of readings about their positions and the rig; without `parameters` none has derivatives by those."""
    measured, at = each.measured, each.positions
    kind, sensors = measured.kind, measured.sensors
    predicted = kind.values_at(at, sensors)
    moves = _STEP * np.eye(3)

    def slope(values: np.ndarray) -> np.ndarray:
        return wrapped(values - predicted, measured.columns) / _STEP

    errors = np.nan_to_num(wrapped(measured.values - predicted, measured.columns))
    by_position = np.stack([slope(kind.values_at(at + move, sensors)) for move in moves], axis=2).reshape(-1, 3)
    first = {source.name: source.first for source in sources if source.table == kind.name}
    firsts = np.array([first.get(name, 0) for name in measured.ids], int)[sensors.number]
    numbers, slopes = [np.zeros((len(at), 0), int)], [np.zeros((*predicted.shape, 0))]
    for slot in range(sensors.number.shape[1] if parameters else 0):
        by_place = [slope(kind.values_at(at, _moved(sensors, slot, move))) for move in moves]
        constant = np.full_like(predicted, 1.0 if slot == 0 else -1.0)
        if kind.angles:
            turn = sensors._replace(axes=about_vertical(_STEP) @ sensors.axes)
            constant = np.broadcast_to([0.0, 1.0], predicted.shape)
            slopes.append(slope(kind.values_at(at, turn))[..., None])
        slopes += [constant[..., None], np.stack(by_place, axis=2)]
        numbers.append(firsts[:, slot, None] + np.arange(len(OF_STATION if kind.angles else OF_ANCHOR)))
    return Rows(
        errors.ravel(),
        each.weights.ravel(),
        by_position,
        np.repeat(np.concatenate(numbers, axis=1), errors.shape[1], axis=0),
        np.concatenate(slopes, axis=2).reshape(errors.size, -1),
    )


def _moved(sensors: Sensors, slot: int, move: np.ndarray) -> Sensors:
    """The sensors with those in one slot of the readings moved."""
    number = sensors.number + len(sensors.places) * (np.arange(sensors.number.shape[1]) == slot)
    return doubled(sensors, sensors.places + move, sensors.axes)._replace(number=number)


def doubled(sensors: Sensors, places: np.ndarray, axes: np.ndarray) -> Sensors:
    """The sensors, and after them, numbered on, the same ones at other places and with other axes."""
    twice = {name: np.concatenate([getattr(sensors, name)] * 2) for name in ("antennas", "wavelengths")}
    both = {"places": np.concatenate([sensors.places, places]), "axes": np.concatenate([sensors.axes, axes])}
    return sensors._replace(**both, **twice)


def blocks_of(
    readings: Mapping[str, Readings],
    sources: Sequence[Source],
    width: float,
    cell_m: float,
    about: tuple[float, int] = TRACKED,
) -> Blocks:
    """The blocks of readings in windows of `width` s and places of `cell_m`, as the tracked positions have them.

    `about`: how far tracked positions are off, m, and how often they are corrected before.
    """
    parts = [_scores(piece, sources, width, about) for piece in _pieces(readings, width)]
    track, time, position, score, information, energy = (np.concatenate(x) for x in zip(*parts, strict=True))
    keys = np.column_stack([np.floor(time / SLOT_S), track, np.floor(position / cell_m)]).astype(int)
    unique, number = np.unique(keys, axis=0, return_inverse=True)
    order = np.argsort(number.ravel(), kind="stable")
    starts = np.searchsorted(number.ravel()[order], np.arange(len(unique)))
    sums = (np.add.reduceat(x[order], starts, axis=0) for x in (score, information, energy))
    return Blocks(unique[:, 1], unique[:, 0], unique[:, 2:], *sums)


def _pieces(readings: Mapping[str, Readings], width: float) -> Iterator[dict[str, Readings]]:
    """The readings in pieces of whole windows, few enough for memory."""
    keys = {table: window_keys(each, width) for table, each in readings.items()}
    every = np.sort(np.concatenate(list(keys.values())))
    for low, high in pairwise([-np.inf, *np.unique(every[_ROWS::_ROWS]), np.inf]):
        parts = {t: each.of_rows((keys[t] >= low) & (keys[t] < high)) for t, each in readings.items()}
        if any(len(each.times) for each in parts.values()):
            yield {t: each for t, each in parts.items() if len(each.times)}


def window_keys(each: Readings, width: float) -> Float[np.ndarray, " N"]:
    """A number of the track and the window of each reading."""
    return each.track * 2.0**32 + np.floor(each.times / width)


class _Windows:
    """Readings by windows: W windows of at most L values, and the shifts of their positions that were found so far."""

    def __init__(self, readings: Mapping[str, Readings], width: float, sigma: float) -> None:
        self.readings, self.given = dict(readings), list(readings.values())
        keys = np.concatenate([window_keys(each, width) for each in self.given])
        _, self.first, self.of_reading = np.unique(keys, return_index=True, return_inverse=True)
        self.of_table = np.split(self.of_reading, np.cumsum([len(each.times) for each in self.given])[:-1])
        pairs = zip(self.of_table, self.given, strict=True)
        window = np.concatenate([np.repeat(number, each.weights.shape[1]) for number, each in pairs])
        self._order = np.argsort(window, kind="stable")
        starts = np.searchsorted(window[self._order], np.arange(len(self.first)))
        self._at = window[self._order], np.arange(len(window)) - starts[window[self._order]]
        self.weight = self.padded([each.weights.ravel() for each in self.given])
        self.prior = np.full((len(self.first), 3), sigma**-2)
        self.prior[self.mean(self.joined("level")) > 0, 2] = _LEVEL
        self.shift = np.zeros_like(self.prior)

    def joined(self, name: str) -> np.ndarray:
        """A column of all readings as they were given."""
        return np.concatenate([getattr(each, name) for each in self.given])

    def padded(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Values of all readings (n, …) by windows (W, L, …)."""
        values = np.concatenate(parts)
        result = np.zeros((len(self.first), int(self._at[1].max()) + 1, *values.shape[1:]))
        result[self._at] = values[self._order]
        return result

    def mean(self, values: np.ndarray) -> np.ndarray:
        """The mean over each window."""
        return np.bincount(self.of_reading, values) / np.bincount(self.of_reading)

    def solved(self, rows: Sequence[Rows]) -> tuple[np.ndarray, ...]:
        """The weighted derivatives (W, 3, L), the information (W, 3, 3), the slope and the best shift (W, 3)."""
        J = self.padded([row.by_position for row in rows])
        weighted = (J * self.weight[..., None]).transpose(0, 2, 1)
        A = weighted @ J + self.prior[:, None] * np.eye(3)
        a = (weighted @ self.padded([row.errors for row in rows])[..., None])[..., 0] - self.prior * self.shift
        return weighted, A, a, np.linalg.solve(A, a[..., None])[..., 0]

    def correct(self, sources: Sequence[Source], rounds: int) -> None:
        """Corrects the positions of `readings`, by Gauss and Newton."""
        for _ in range(rounds):
            move = self.solved([linearised(each, sources, False) for each in self.readings.values()])[3]
            self.shift = self.shift + move
            pairs = zip(self.readings.items(), self.of_table, strict=True)
            self.readings = {t: replace(r, positions=r.positions + move[number]) for (t, r), number in pairs}


def located(readings: Mapping[str, Readings], sources: Sequence[Source], width: float) -> dict[str, Readings]:
    """The readings about the best positions of their windows."""
    windows = _Windows(readings, width, LOST[0])
    windows.correct(sources, LOST[1])
    return windows.readings


def _scores(
    readings: Mapping[str, Readings], sources: Sequence[Source], width: float, about: tuple[float, int]
) -> tuple[np.ndarray, ...]:
    """Of each window: track, mean time, mean tracked x and y, score, information and energy."""
    windows = _Windows(readings, width, about[0])
    windows.correct(sources, about[1])
    rows = [linearised(each, sources) for each in windows.readings.values()]
    weighted, A, a, move = windows.solved(rows)
    error, G = (
        windows.padded([row.errors for row in rows]),
        windows.padded([row.by_all(count_of(sources)) for row in rows]),
    )
    weighted_G, B = (G * windows.weight[..., None]).transpose(0, 2, 1), weighted @ G
    gain = np.linalg.solve(A, B).transpose(0, 2, 1)
    score = (weighted_G @ error[..., None] - gain @ a[..., None])[..., 0]
    energy = (windows.weight * error**2).sum(axis=1) + (windows.prior * windows.shift**2 - move * a).sum(axis=1)
    where = np.stack([windows.mean(column) for column in windows.joined("positions")[:, :2].T], axis=1)
    track, times = windows.joined("track")[windows.first], windows.mean(windows.joined("times"))
    return track, times, where, score, weighted_G @ G - gain @ B, energy


def count_of(sources: Sequence[Source]) -> int:
    """The number of parameters of all sources."""
    return sum(len(source.parameters) for source in sources)
