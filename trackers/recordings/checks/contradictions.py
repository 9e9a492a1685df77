"""Ranges without truth: what makes those of one moment agree, at the position that fits them best, solved anew each."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.checks import CheckResult, Level
from trackwright.trackers.recordings.checks.mistakes import FACTORS, UNITS
from trackwright.trackers.recordings.checks.readings import known_median

# Moments compared, ranges of one beyond its unknowns, errors that contradict, m, by how much a change lowers them, how
# many may stay, steps to a position, and anchors of which two may be swapped.
MOMENTS, SPARE, LARGE, FALL, FEW, STEPS, MOST_SWAPPED = 60, 2, 0.5, 3.0, 0.25, 12, 12


class Moments(NamedTuple):
    """Ranges of M moments, m, NaN of anchors not heard, places of the A anchors, and known heights, else NaN."""

    ranges: Float[np.ndarray, "M A"]
    places: Float[np.ndarray, "A 3"]
    heights: Float[np.ndarray, " M"]

    def errors(self) -> Float[np.ndarray, "M A"]:
        """The distances of the ranges from those of the position that fits most of each moment."""
        heard, known = np.isfinite(self.ranges), np.isfinite(self.heights)
        x = np.repeat(self.places.mean(axis=0)[None], len(heard), axis=0)
        x[:, 2] = np.where(known, self.heights, self.places[:, 2].min() - 1.0)
        free = np.where(known[:, None], [1.0, 1.0, 0.0], 1.0)
        for _ in range(STEPS):
            away = x[:, None] - self.places
            distance = np.maximum(np.linalg.norm(away, axis=2), 1e-3)
            error = np.where(heard, distance - self.ranges, 0.0)
            scale = np.maximum(np.nanmedian(np.where(heard, np.abs(error), np.nan), axis=1), 0.05)
            weight = heard / (1.0 + (error / (2.0 * scale[:, None])) ** 2)
            slope = away / distance[..., None] * free[:, None]
            normal = np.einsum("ma,mai,maj->mij", weight, slope, slope) + 0.02 * np.eye(3)
            x -= np.linalg.solve(normal, np.einsum("ma,ma,mai->mi", weight, error, slope)[..., None])[..., 0]
        return np.where(heard, np.abs(error), np.nan)


def moments_of(rig: Rig, ranges: pl.DataFrame) -> Moments:
    """Moments of tags in which so many anchors are heard that their ranges can contradict each other."""
    names, known = [*rig.anchors], {tag: of.height for tag, of in rig.tags.items() if of.height is not None}
    table = ranges.select("t_s", "range_m", pl.col("tag", "anchor").cast(pl.String)).filter(pl.col("range_m") > 0)
    step = table.group_by("tag").agg((pl.col("t_s").max() - pl.col("t_s").min()) / pl.len())["t_s"].median()
    window = min(max(1.5 * len(names) * float(step or 0.0), 0.1), 1.0)  # type: ignore[arg-type]
    at = table.with_columns(at=(pl.col("t_s") / window).floor())
    wide = at.pivot("anchor", index=["tag", "at"], values="range_m", aggregate_function="median")
    empty = np.full(len(wide), np.nan)
    values = np.stack([wide[name].to_numpy() if name in wide.columns else empty for name in names], axis=1)
    heights = np.array([known.get(tag, np.nan) for tag in wide["tag"]])
    enough = np.flatnonzero(np.isfinite(values).sum(axis=1) >= np.where(np.isfinite(heights), 2, 3) + SPARE)
    enough = enough[:: -(-len(enough) // MOMENTS) or 1]
    return Moments(values[enough], np.stack([*rig.anchors.values()]), heights[enough])


def _changes(given: Moments, names: list[str], typical: np.ndarray) -> Iterator[tuple[str, list[int], Moments]]:
    """What would explain contradictions: its words, the anchors whose errors it lowers, and the moments with it."""
    everyone, number = [*range(len(names))], np.arange(len(names))
    for f, unit in UNITS["range_m"].items():
        words = f"with the ranges multiplied by {f:g}: {unit}; convert them"
        yield words, everyone, given._replace(ranges=given.ranges * f)
    for f, unit in FACTORS.items():
        words = f"with the positions of the anchors multiplied by {f:g}: rig.toml is in {unit}; convert it"
        yield words, everyone, given._replace(places=given.places * f)
    words = "with other heights of the tags: correct height_m in rig.toml"
    yield words, everyone, given._replace(heights=np.full(len(given.heights), np.nan))
    for k, name in enumerate(names):
        words = f"without anchor {name}: its id, place or unit is wrong, or it is broken"
        yield words, [k], given._replace(ranges=np.where(number == k, np.nan, given.ranges))
    worst = sorted(np.argsort(-typical)[:MOST_SWAPPED].tolist())
    for i, j in combinations([k for k in worst if typical[k] > LARGE / 5], 2):
        order = [{i: j, j: i}.get(k, k) for k in everyone]
        words = f"with anchors {names[i]} and {names[j]} swapped: their ids are mixed up; correct rig.toml or the table"
        yield words, [i, j], given._replace(places=given.places[order])


def _medians(errors: np.ndarray) -> np.ndarray:
    """The typical error (A,) of each anchor, 0 of one that is not heard."""
    return np.nan_to_num(known_median(errors))


def check_contradictions(rig: Rig, ranges: pl.DataFrame) -> Iterator[CheckResult]:
    """An error for the change with which the ranges agree best; a warning of one anchor that contradicts the others."""
    names = [*rig.anchors]
    if len(names) < 2 + SPARE or len((given := moments_of(rig, ranges)).ranges) < 5:
        return
    before, heard, found = given.errors(), np.isfinite(given.ranges), list[tuple[float, Level, str]]()
    typical, everyone = _medians(before), [*range(len(names))]
    if typical.max() <= LARGE:
        return
    for words, of, changed in _changes(given, names, typical):
        after, alone = changed.errors(), words.startswith("without")
        was, left = typical[of].max(), _medians(after)[everyone if alone else of].max()
        if was > LARGE and left < was / FALL and np.mean(after[np.isfinite(after)] > LARGE) < FEW:
            # A range without its anchor remains unexplained.
            cost = float(np.mean(np.log(np.where(np.isfinite(after), after, LARGE)[heard] + 0.05)))
            found.append((cost, "warning" if alone else "error", f"by {was:.2g} m, and by {left:.2g} m {words}"))
    if found:
        _, level, words = min(found)
        yield CheckResult(level, "ranges", f"contradict each other {words}")
        return
    named = listed([name for name, size in zip(names, typical, strict=True) if size > LARGE])
    yield CheckResult("warning", "ranges", f"of {named} contradict others of the same moment by {typical.max():.2g} m")
