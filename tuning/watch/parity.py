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

from trackwright.trackers.recordings.kinds import Sensors, wrapped
from trackwright.tuning.watch.readings import OF_ANCHOR, OF_STATION, SLOT_S, Readings, Source

POSITION_SIGMA = 1.0
"""Standard deviation, m, of a tracked position before the readings of its window."""

ROUNDS = 1
"""How often the positions of windows are corrected before scores are computed about them."""

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
            turn = sensors._replace(axes=turned(_STEP) @ sensors.axes)
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


def turned(angle: float) -> np.ndarray:
    """The matrix (3, 3) of a turn about the vertical, rad."""
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def blocks_of(
    readings: Mapping[str, Readings], sources: Sequence[Source], width: float, cell_m: float, rounds: int = ROUNDS
) -> Blocks:
    """The blocks of readings in windows of `width` s and places of `cell_m`, as the tracked positions have them."""
    parts = [_windows(piece, sources, width, rounds) for piece in _pieces(readings, width)]
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


def _windows(
    readings: Mapping[str, Readings], sources: Sequence[Source], width: float, rounds: int
) -> tuple[np.ndarray, ...]:
    """Of each window: track, mean time, mean tracked x and y, score, information and energy."""
    given = list(readings.values())
    _, first, of_reading = np.unique(
        np.concatenate([window_keys(each, width) for each in given]), return_index=True, return_inverse=True
    )
    of_table = np.split(of_reading, np.cumsum([len(each.times) for each in given])[:-1])
    window = np.concatenate([np.repeat(w, r.weights.shape[1]) for w, r in zip(of_table, given, strict=True)])
    order = np.argsort(window, kind="stable")
    within = np.arange(len(order)) - np.searchsorted(window[order], np.arange(len(first)))[window[order]]
    of_padded = window[order], within

    def padded(parts: Sequence[np.ndarray]) -> np.ndarray:
        values = np.concatenate(parts)
        result = np.zeros((len(first), int(within.max()) + 1, *values.shape[1:]))
        result[of_padded] = values[order]
        return result

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(each, name) for each in given])

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(of_reading, values) / np.bincount(of_reading)

    prior = np.full((len(first), 3), POSITION_SIGMA**-2)
    prior[mean(joined("level")) > 0, 2] = _LEVEL
    weight, shift, current = padded([each.weights.ravel() for each in given]), np.zeros((len(first), 3)), given
    for left in range(rounds, -1, -1):
        rows = [linearised(each, sources, left == 0) for each in current]
        error, J = padded([row.errors for row in rows]), padded([row.by_position for row in rows])
        weighted = (J * weight[..., None]).transpose(0, 2, 1)
        A = weighted @ J + prior[:, None] * np.eye(3)
        a = (weighted @ error[..., None])[..., 0] - prior * shift
        move = np.linalg.solve(A, a[..., None])[..., 0]
        if left:
            shift = shift + move
            current = [replace(r, positions=r.positions + move[w]) for r, w in zip(current, of_table, strict=True)]
    G = padded([row.by_all(count_of(sources)) for row in rows])
    weighted_G, B = (G * weight[..., None]).transpose(0, 2, 1), weighted @ G
    gain = np.linalg.solve(A, B).transpose(0, 2, 1)
    score = (weighted_G @ error[..., None] - gain @ a[..., None])[..., 0]
    energy = (weight * error**2).sum(axis=1) + (prior * shift**2).sum(axis=1) - (move * a).sum(axis=1)
    where = np.stack([mean(column) for column in joined("positions")[:, :2].T], axis=1)
    return joined("track")[first], mean(joined("times")), where, score, weighted_G @ G - gain @ B, energy


def count_of(sources: Sequence[Source]) -> int:
    """The number of parameters of all sources."""
    return sum(len(source.parameters) for source in sources)
