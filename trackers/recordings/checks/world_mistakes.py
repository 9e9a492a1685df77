"""Explanations of errors by the truth as a whole: units, frame, clock; and by swapped tags, anchors or stations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from trackwright.trackers.recordings.checks.compared import Compared
from trackwright.trackers.recordings.checks.explanations import (
    FACTORS,
    Explanation,
    metres,
    signed_axes,
    sizes_with,
    transform_text,
)
from trackwright.trackers.recordings.checks.readings import known_median
from trackwright.trackers.recordings.checks.robust_fit import robust_fit

FEW, COARSE = 240, 600
"""Readings for the first search of a frame, and for that of a delay."""

TURNS = 5
"""Turns of the truth from which a frame is fitted: those with the smallest errors of 24."""

LONGEST_DELAY_S = 60.0
LATENCY_S = 1.0
"""Delays of measurements up to here are a property of the sensor."""

LEAST_SHIFT_M, LEAST_YAW = 0.4, np.radians(4.0)
FARTHEST_M = 200.0
"""Shift of the truth, m, up to which phases are compared with it: far away on the boresight all are equal."""

LEAST_MOTION_M = 0.5
CLEAR = 1.5
"""Sum of the log ratios of errors from which two of them count as swapped."""

MOST_SWAPPED = 32
"""Anchors, stations or tags that are compared with each other's places."""


def world_explanations(view: Compared) -> Iterator[Explanation]:
    """Changes of the truth, of the rig, and of the names of anchors, stations and tags."""
    yield from _units(view)
    yield from _axes(view)
    yield from _shifted(view)
    yield from _turned(view)
    yield from _delayed(view)
    yield from _swapped_sensors(view)
    yield from _swapped_tags(view)


def _units(view: Compared) -> Iterator[Explanation]:
    for factor, unit in FACTORS:
        if view.kind.position:
            yield Explanation(
                f"the {view.table} multiplied by {factor:g}", f"{view.table} in {unit}, expected metres; convert them",
                sizes_with(view, values=factor * view.values),
            )  # fmt: skip
        yield Explanation(
            f"the truth multiplied by {factor:g}", f"truth in {unit}, expected metres; convert it",
            sizes_with(view, positions=factor * view.positions),
        )  # fmt: skip
        if not view.kind.position:
            yield Explanation(
                f"the positions of the {view.noun}s multiplied by {factor:g}",
                f"positions in rig.toml in {unit}, expected metres; convert them",
                sizes_with(view, places=factor * view.places),
            )  # fmt: skip


def _axes(view: Compared) -> Iterator[Explanation]:
    """Axes of the truth exchanged or with another sign."""
    for axes in signed_axes("the truth"):
        if axes.changes:
            yield Explanation(
                axes.words, _frame_cause(view, "has other axes than"),
                sizes_with(view, positions=view.positions @ axes.matrix.T) * (1.0 + 0.01 * axes.changes),
                # The maker's height is often of no use, or mirrored in the plane of the anchors.
                harmless=view.kind.position and axes.words == "the sign of z of the truth flipped",
            )  # fmt: skip


def _frame_cause(view: Compared, what: str, placement: Sequence[float] = ()) -> str:
    """The cause, and the fix: where a shift, m, and turn, °, are enough, by import."""
    other = f"the {view.table}" if view.kind.position else "rig.toml"
    moving = f"--align-truth, which fits the clock as well, or --transform {transform_text(placement)}"
    fix = f"import it again with {moving}" if len(placement) else "bring both into one frame"
    return f"the truth {what} {other}; {fix}"


def _shifted(view: Compared) -> Iterator[Explanation]:
    start = np.zeros(3)

    def errors(shift: np.ndarray, part: Compared = view) -> np.ndarray:
        return part._replace(positions=part.positions + shift).errors()

    few = view.thinned(FEW)
    centre = view.positions.mean(axis=0)
    target = _middle(view, centre)
    starts = (start, target - centre, np.append((target - centre)[:2], 0.0))
    rough = min((robust_fit(lambda x: errors(x, few), x0, 8) for x0 in starts), key=lambda fit: fit[1])[0]
    shift, _ = robust_fit(errors, rough, 4)
    if LEAST_SHIFT_M <= np.linalg.norm(shift) <= _farthest(view):
        yield Explanation(
            f"the truth shifted by {metres(shift)}", _frame_cause(view, "has another origin than", (*shift, 0.0)),
            sizes_with(view, positions=view.positions + shift), 3,
            harmless=view.kind.position and bool(np.linalg.norm(shift[:2]) < LEAST_SHIFT_M),
        )  # fmt: skip


def _middle(view: Compared, centre: np.ndarray) -> np.ndarray:
    """The mean (3,) of fixes, or of anchors or stations; the `centre` of the truth along an axis without a fix."""
    if not view.kind.position:
        return np.asarray(view.places.mean(axis=0))
    known = np.isfinite(view.values)
    sums = np.where(known, view.values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), sums / np.maximum(known.sum(axis=0), 1), centre)


def _turned(view: Compared) -> Iterator[Explanation]:
    """The truth turned about z, mirrored or not, and shifted."""
    few = view.thinned(FEW)
    centre = view.positions.mean(axis=0)
    target = np.append(_middle(view, centre)[:2], centre[2])
    for mirrored in (False, True):

        def errors(x: np.ndarray, part: Compared = view, mirrored: bool = mirrored) -> np.ndarray:
            return part._replace(positions=_placed(part.positions, centre, x, mirrored)).errors()

        starts = [np.append(yaw, c) for yaw in np.arange(24) * np.pi / 12 for c in (centre, target)]
        starts.sort(key=lambda x: float(np.nanmean(np.log1p(np.abs(errors(x, few))))))
        near = starts[:TURNS]
        rough = min((robust_fit(lambda x: errors(x, few), x0, 8) for x0 in near), key=lambda fit: fit[1])[0]
        x, _ = robust_fit(errors, rough, 4)
        yaw = float(np.mod(x[0] + np.pi, 2 * np.pi) - np.pi)
        if not mirrored and abs(yaw) < LEAST_YAW:
            continue
        if np.linalg.norm(x[1:] - centre) > _farthest(view):
            continue
        origin = _placed(np.zeros((1, 3)), centre, x, mirrored)[0]
        words = f"{'mirrored (y flipped), then ' if mirrored else ''}turned by {np.degrees(yaw):.1f}° about z"
        if np.linalg.norm(origin) >= LEAST_SHIFT_M:
            words += f" and shifted by {metres(origin)}"
        yield Explanation(
            f"the truth {words}",
            _frame_cause(view, "is mirrored against")
            if mirrored
            else _frame_cause(view, "is turned against", (*origin, np.degrees(yaw))),
            sizes_with(view, positions=_placed(view.positions, centre, x, mirrored)), 5 if mirrored else 4,
        )  # fmt: skip


def _farthest(view: Compared) -> float:
    return FARTHEST_M if view.kind.numbered else np.inf


def _placed(positions: np.ndarray, centre: np.ndarray, x: np.ndarray, mirrored: bool) -> np.ndarray:
    """Positions mirrored in y, turned by x[0] about `centre`, which goes to x[1:]."""
    away = (positions - centre) * np.array([1.0, -1.0 if mirrored else 1.0, 1.0])
    c, s = np.cos(x[0]), np.sin(x[0])
    return x[1:] + away @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _delayed(view: Compared) -> Iterator[Explanation]:
    """The truth of some seconds before or after."""
    extent = max(np.linalg.norm(np.ptp(view.positions[view.tag == k], axis=0)) for k in np.unique(view.tag))
    span = float(np.ptp(view.times))
    if extent < LEAST_MOTION_M or span < 2.0:
        return
    longest, few = min(LONGEST_DELAY_S, 0.45 * span), view.thinned(COARSE)
    best, step = 0.0, 1.0
    grid = np.arange(-longest, longest + step, step)
    while step > 0.02:
        part = few if step > 0.1 else view
        best = min(grid, key=lambda delay: _total(part.later(delay)))
        grid, step = best + step * np.arange(-1.0, 1.01, 0.25), step / 4
    late = "late" if best > 0 else "early"
    yield Explanation(
        f"the measurements taken {abs(best):.2f} s {'earlier' if best > 0 else 'later'}",
        f"the {view.table} come {abs(best):.2f} s {late}: their clock and that of the truth differ; "
        f"import the truth again with --align-truth, or --transform {transform_text((0.0, 0.0, 0.0, 0.0, best))}",
        _sizes(view.later(best)), 1, harmless=-LATENCY_S / 2 < best <= LATENCY_S,
    )  # fmt: skip


def _sizes(view: Compared) -> np.ndarray:
    return view.sizes(view.errors())


def _total(view: Compared) -> float:
    sizes = _sizes(view)
    return float(np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum())


def _swapped_sensors(view: Compared) -> Iterator[Explanation]:
    """Each anchor or station at the place of another."""
    count = len(view.ids)
    if len(view.kind.sensors) != 1 or not 2 <= count <= MOST_SWAPPED:
        return
    few = view.thinned(max(FEW, 60 * count))
    found = [
        sizes_with(few, places=np.tile(view.places[k], (count, 1)), axes=np.tile(view.axes[k], (count, 1, 1)))
        for k in range(count)
    ]
    order = _assignment(np.stack([_log(sizes) for sizes in found], axis=1))
    if (order == np.arange(count)).all():
        return
    yield Explanation(
        _exchange(view.noun, view.ids, order), f"the ids of {view.noun}s are mixed up; correct rig.toml or the table",
        sizes_with(view, places=view.places[order], axes=view.axes[order]), own=True,
        groups=order != np.arange(count), together=True,
    )  # fmt: skip


def _swapped_tags(view: Compared) -> Iterator[Explanation]:
    """Each tag on the path of another."""
    used = np.array([k for k in np.unique(view.tag) if view.tags[k] in view.paths.number])
    if not 2 <= len(used) <= MOST_SWAPPED:
        return
    few = view.thinned(max(FEW, 60 * len(used)))
    costs = np.zeros((len(used), len(used)))
    for j, other in enumerate(used):
        errors = np.abs(few.later(0.0, np.full(len(view.tags), other)).errors())
        for i, tag in enumerate(used):
            costs[i, j] = _log(known_median(errors[few.tag == tag])[None])[0]
    order = _assignment(costs)
    if (order == np.arange(len(used))).all():
        return
    of = np.arange(len(view.tags))
    of[used] = used[order]
    yield Explanation(
        _exchange("tag", [view.tags[k] for k in used], order),
        "the ids of tags are mixed up between truth and measurements; correct one table",
        _sizes(view.later(0.0, of)), 1,
    )  # fmt: skip


def _log(sizes: np.ndarray) -> np.ndarray:
    """The sum over columns (G,) of the logarithms of sizes, large where one is unknown."""
    total: np.ndarray = np.log(np.where(np.isfinite(sizes), np.maximum(sizes, 1e-3), 1e3)).sum(axis=1)
    return total


def _assignment(costs: np.ndarray) -> np.ndarray:
    """The column of each row (n,), no two equal, that makes the sum small: only exchanges that clearly do."""
    from scipy.optimize import linear_sum_assignment  # a quarter of a second, and few recordings come here

    order = linear_sum_assignment(costs)[1]
    found = np.arange(len(costs))
    for first in found.tolist():
        exchanged, last = [first], first
        while (last := int(order[last])) != first:
            exchanged.append(last)
        if costs[exchanged, exchanged].sum() - costs[exchanged, order[exchanged]].sum() > CLEAR:
            found[exchanged] = order[exchanged]
    return found


def _exchange(noun: str, ids: tuple[str, ...] | list[str], order: np.ndarray) -> str:
    moved = [k for k in range(len(ids)) if order[k] != k]
    if len(moved) == 2:
        return f"{noun}s {ids[moved[0]]} and {ids[moved[1]]} swapped"
    return f"{noun}s exchanged ({', '.join(f'{ids[k]} for {ids[order[k]]}' for k in moved)})"
