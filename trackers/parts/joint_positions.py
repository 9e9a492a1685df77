"""Positions for starts from the readings of several kinds, or of range differences, on the host.

The kinds' predictions are in `recordings.kinds`. The Cauchy loss of all readings of the last seconds is taken on a grid
over the room; the best point, and the best one far from it, are refined by Gauss–Newton steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.model.rig import room_rows
from trackwright.trackers.parts.multilaterate import WINDOWS_S
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Measured, wrapped

# Time, s, between positions for a start, how long after the first row, and the time between later ones, for tracks that
# were lost. The latest readings of each kind that count. Cells of the grid along each side of the room. Gauss–Newton
# steps, whose scales of the loss begin with the cells of the grid and halve to the kinds' own.
SPACING_S, SOON_S, LATER_S, RECENT, CELLS, STEPS = 0.2, 5.0, 1.0, 16, 8, 8
# Standard deviation along the worst horizontal direction above which a position is not determined, m. Difference of the
# losses of two places below which either may be the position, horizontal distance from which on two places are two, m.
LARGEST_STD, RIVAL, APART = 1.5, 2.0, 1.0
BLOCK, STEP_M = 128, 1e-4  # positions computed at once; step of numerical derivatives, m


class Given(NamedTuple):
    """The latest readings of one kind at M moments, R each: `measured` has M·R rows; `counts` (M, R, m)."""

    measured: Measured
    counts: Bool[np.ndarray, "M R m"]

    @property
    def scale(self) -> Float[np.ndarray, " m"]:
        """The scale of the loss: the size of errors that need no explanation."""
        return self.measured.kind.sizes("large", self.counts.shape[2])

    def predicted(self, place: Float[np.ndarray, "H M 3"]) -> Float[np.ndarray, "H M R m"]:
        """The values that positions imply."""
        each = np.repeat(place, self.counts.shape[1], axis=1)
        values = [self.measured.kind.values_at(positions, self.measured.sensors) for positions in each]
        return np.stack(values).reshape(len(place), *self.counts.shape)

    def errors(self, predicted: Float[np.ndarray, "H M R m"]) -> Float[np.ndarray, "H M R m"]:
        """Values less predicted ones, zero where none counts."""
        values = self.measured.values.reshape(self.counts.shape)
        return np.where(self.counts, wrapped(values - predicted, self.measured.columns), 0.0)


def joint_positions(
    folder: RecordingFolder, kinds: Sequence[str], tags: Sequence[str], starts: Int[np.ndarray, " ends"],
    times: Float[np.ndarray, " N"], heights: Float[np.ndarray, " n"], nearby: Float[np.ndarray, "N 4"],
) -> Float[np.ndarray, "N 4"]:  # fmt: skip
    """`nearby` with positions from the readings of all kinds, and 1, at those `start_rows` that have none.

    `starts` (n + 1,): the first row of each of n tags, then N. `heights` (n,) m: NaN where unknown.
    """
    result = nearby.copy()
    tag = np.repeat(np.arange(len(tags)), np.diff(starts))
    sought = start_rows(starts, times) & (result[:, 3] == 0)
    if not sought.any():
        return result
    tables = [folder.rows(name) for name in kinds]
    measured = [KINDS[name].measured(folder.rig, rows).usable for name, rows in zip(kinds, tables, strict=True)]
    for window in WINDOWS_S:
        for known in (True, False):
            wanted = np.flatnonzero(sought & (result[:, 3] == 0) & (np.isfinite(heights[tag]) == known))
            for begin in range(0, len(wanted), BLOCK):
                part = wanted[begin : begin + BLOCK]
                of_tags = [tags[k] for k in tag[part]]
                given = [_given(*of, of_tags, times[part], window) for of in zip(measured, tables, strict=True)]
                place, determined = _located(folder, given, heights[tag[part]])
                result[part] = np.where(determined[:, None], np.column_stack([place, np.ones(len(part))]), 0.0)
    return result


def _given(
    measured: Measured, rows: TagRows, tags: Sequence[str], times: Float[np.ndarray, " M"], window: float
) -> Given:
    """The latest readings of a kind, and of its table's rows, up to M moments of tags."""
    number = {tag: k for k, tag in enumerate(rows.tags)}
    ends = np.zeros((len(tags), 2), int)
    for k, (tag, time) in enumerate(zip(tags, times, strict=True)):
        if tag in number:
            first, last = rows.starts[number[tag]], rows.starts[number[tag] + 1]
            ends[k] = first, first + np.searchsorted(rows.times[first:last], time, "right")
    at = ends[:, 1:] - 1 - np.arange(RECENT)
    counts = at >= ends[:, :1]
    at = np.maximum(at, 0)
    counts &= times[:, None] - rows.times[at] <= window
    latest = measured.of_rows(at.ravel())
    return Given(latest, counts[..., None] & np.isfinite(latest.values).reshape(*at.shape, -1))


def _located(
    folder: RecordingFolder, given: Sequence[Given], heights: Float[np.ndarray, " M"]
) -> tuple[Float[np.ndarray, "M 3"], Bool[np.ndarray, " M"]]:
    """The position of least loss at each of M moments, m, and whether the readings determine it and no other one."""
    n = 3 if np.isnan(heights).all() else 2
    sites = np.array([place for kind in given for place in kind.measured.sensors.places]).reshape(-1, 3)
    low_x, high_x, low_y, high_y = room_rows(sites, folder.rig.outline, 1)[0]
    cell = max(high_x - low_x, high_y - low_y) / CELLS
    along = (np.arange(CELLS) + 0.5) / CELLS
    levels = np.zeros(1) if n == 2 else sites[:, 2].mean() + np.array([-1.0, 1.0])
    x, y, z = np.meshgrid(low_x + along * (high_x - low_x), low_y + along * (high_y - low_y), levels)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 1, 3)
    grid = np.repeat(points, len(heights), axis=1)
    if n == 2:
        grid[..., 2] = heights
    loss, moments = _loss(given, grid, cell), np.arange(len(heights))
    first = np.argmin(loss, axis=0)
    away = np.linalg.norm(points[..., :2] - points[first, 0, :2], axis=-1)
    second = np.argmin(np.where(away > 2.0 * cell, loss, np.inf), axis=0)
    place = grid[np.stack([first, second]), moments]
    for step in range(STEPS):
        place = _moved(given, place, n, cell * 0.5**step)
    loss = _loss(given, place, 0.0)
    apart = np.linalg.norm((place[0] - place[1])[:, :2], axis=1) > APART
    rival = apart & (np.abs(loss[0] - loss[1]) < RIVAL)
    place = place[np.argmin(loss, axis=0), moments]
    return place, _determined(given, place, n) & ~rival


def _scaled(given: Given, least: float) -> Float[np.ndarray, " m"]:
    """The scales of the loss of a kind, of lengths at least `least` m."""
    lengths = np.array([not column.endswith("_rad") for column in given.measured.columns])
    return np.where(lengths, np.maximum(given.scale, least), given.scale)


def _loss(given: Sequence[Given], place: Float[np.ndarray, "H M 3"], least: float) -> Float[np.ndarray, "H M"]:
    """The Cauchy loss of all readings."""
    losses = (
        np.log1p((kind.errors(kind.predicted(place)) / _scaled(kind, least)) ** 2).sum(axis=(2, 3)) for kind in given
    )
    return np.sum(list(losses), axis=0)


def _linearised(
    given: Sequence[Given], place: Float[np.ndarray, "H M 3"], n: int, least: float
) -> tuple[Float[np.ndarray, "H M S"], Float[np.ndarray, "H M S n"]]:
    """The errors in units of their scales, and the derivatives of the predictions, zero where none counts."""
    errors, slopes = [], []
    for kind in given:
        predicted, scale = kind.predicted(place), _scaled(kind, least)
        errors.append((kind.errors(predicted) / scale).reshape(*place.shape[:2], -1))
        change = [
            wrapped(kind.predicted(place + STEP_M * np.eye(3)[k]) - predicted, kind.measured.columns) for k in range(n)
        ]
        slope = np.stack(change, axis=-1) / STEP_M * kind.counts[..., None] / scale[:, None]
        slopes.append(slope.reshape(*place.shape[:2], -1, n))
    return np.concatenate(errors, axis=2), np.concatenate(slopes, axis=2)


def _moved(
    given: Sequence[Given], place: Float[np.ndarray, "H M 3"], n: int, least: float
) -> Float[np.ndarray, "H M 3"]:
    """The positions after a Gauss–Newton step on the loss, of at most three metres."""
    errors, slopes = _linearised(given, place, n, least)
    cauchy = 1.0 + errors**2
    weighted = slopes / cauchy[..., None]
    normal = np.einsum("hmsi,hmsj->hmij", weighted, slopes) + 1e-3 * np.eye(n)
    move = np.linalg.solve(normal, np.einsum("hmsi,hms->hmi", weighted, errors)[..., None])[..., 0]
    move /= np.maximum(np.linalg.norm(move, axis=-1, keepdims=True) / 3.0, 1.0)
    return np.concatenate([place[..., :n] + move, place[..., n:]], axis=-1)


def _determined(given: Sequence[Given], place: Float[np.ndarray, "M 3"], n: int) -> Bool[np.ndarray, " M"]:
    """Whether the readings that agree with positions leave horizontal standard deviations up to `LARGEST_STD`."""
    errors, slopes = (x[0] for x in _linearised(given, place[None], n, 0.0))
    slopes = slopes * (np.abs(errors) < 2.0)[..., None]
    information = np.einsum("msi,msj->mij", slopes, slopes) + 1e-9 * np.eye(n)
    covariance = np.linalg.inv(information)[:, :2, :2]
    return np.linalg.eigvalsh(covariance)[:, 1] <= LARGEST_STD**2


def start_rows(starts: Int[np.ndarray, " ends"], times: Float[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """The rows where a start is sought: the first of every `SPACING_S`, and from `SOON_S` on of every `LATER_S`."""
    tag = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    elapsed = times - times[starts[tag]]
    later = SOON_S / SPACING_S + (elapsed - SOON_S) / LATER_S
    period = np.floor(np.where(elapsed < SOON_S, elapsed / SPACING_S, later))
    return np.append(True, (np.diff(period) != 0) | (np.diff(tag) != 0))
