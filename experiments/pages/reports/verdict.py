"""The verdict on a fit: the log density of the true position on left-out recordings, and why a recording got worse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.comparison import Difference, paired_means
from trackwright.trackers.evaluation.scoring import score
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibration_pairs import calibration_pairs
from trackwright.tuning.data import FLAT_M

OTHER_MOTION = 2.0
"""Ratio of true accelerations from which on a recording has another level of motion."""

CONTRADICTS_M = 0.1
"""Difference, m, of an anchor's median error from that in other recordings from which on it contradicts them."""


class Verdict(NamedTuple):
    """Whether left-out recordings got better.

    `change`: of the mean log density of the true position, nats, all recordings with the same weight; None where it
    cannot be judged, for the reason `why_not`. `recordings`: the same of each. `worse`: what is different in each
    recording that got worse, as far as can be told.
    """

    change: Difference | None
    recordings: Mapping[str, Difference]
    worse: Mapping[str, str]
    why_not: str = ""

    @property
    def word(self) -> str:
        """The verdict in a word or two."""
        if self.change is None:
            return "not judged"
        return "better" if self.change.low > 0 else "worse" if self.change.high < 0 else "not told apart"

    def sentence(self, about: str) -> str:
        """What the verdict is by; `about`: in words, the recordings."""
        if self.change is None:
            return f"{self.why_not[0].upper()}{self.why_not[1:]}."
        return f"Mean log density of the true position, {about}: {changed(self.change)}."

    @property
    def got_worse(self) -> list[str]:
        """A sentence for each recording that got worse."""
        return [f"{name} got worse, {changed(self.recordings[name])}: {why}." for name, why in self.worse.items()]


def density_content(change: Difference) -> dict[str, float]:
    """A change of the log density, nats, as tuned.toml holds it."""
    named = {"before": change.first, "after": change.second, "low_95": change.low, "high_95": change.high}
    return {name: float(f"{value:.6g}") for name, value in named.items()}


def cells(change: Difference | None) -> tuple[str, str]:
    """The log density before and after, and its difference with half its 95 % interval, for a table."""
    if change is None:
        return "– → –", "–"
    half = f"{change.high - change.value:.2f}" if np.isfinite(change.low) else "?"
    return f"{change.first:.2f} → {change.second:.2f}", f"{change.value:+.2f} ± {half}"


def changed(change: Difference) -> str:
    """Both values and their difference with its interval, nats."""
    interval = f"95 % interval {change.low:+.2f} to {change.high:+.2f}"
    if not np.isfinite(change.low):
        interval = f"no interval: too short, {counted(change.pieces, 'piece')} of time longer than errors last"
    return f"{change.first:.2f} → {change.second:.2f} nats, {change.value:+.2f} ({interval})"


def judge(sides: Sequence[Association], folders: Sequence[RecordingFolder], dimensions: int) -> Verdict:
    """The verdict on the estimates of left-out recordings before and after, of the same rows."""
    stations = {folder.name: folder.rig.stations for folder in folders}
    densities = []
    for side in sides:
        scored, full = score(side, stations), np.full(len(side.rows), np.nan)
        full[scored.index] = scored.log_density(dimensions)
        densities.append(full)
    known = np.isfinite(densities).all(axis=0)
    if not known.any():
        return Verdict(None, {}, {}, "no estimate has both a covariance and a truth")
    before, after = (x[known] for x in densities)
    times, names = float_column(sides[0].rows, "t_s")[known], sides[0].rows["recording"].to_numpy()[known]
    rows = {str(name): names == name for name in np.unique(names)}
    changes = {name: paired_means(*(x[of] for x in (times, before, after, names))) for name, of in rows.items()}
    whole, worse = paired_means(times, before, after, names), {}
    for folder in folders:
        change = changes.get(folder.name)
        if change is not None and change.value < 0 and not change.high >= 0:
            worse[folder.name] = _why(folder, folders, sides[1])
    return Verdict(whole, changes, worse)


def _why(folder: RecordingFolder, folders: Sequence[RecordingFolder], after: Association) -> str:
    """What is different in a recording, as far as its truth shows it."""
    others = [other for other in folders if other is not folder]
    reasons = [*(_beside(folder, others) if others else ())]
    side, heights = after.of_recording(folder.name), [float(place[2]) for place in folder.rig.anchors.values()]
    if heights and np.ptp(heights) <= FLAT_M and "z_m" in side.rows.columns:
        estimated, true = float_column(side.rows, "z_m")[side.scored], side.truth[side.scored, 2]
        share = np.mean(np.abs(estimated + true - 2 * np.mean(heights)) < np.abs(estimated - true))
        if share > 0.5:
            reasons.insert(0, f"its height is mirrored in the anchors' plane in {100 * share:.0f} % of the rows")
    return "; ".join(reasons) or "its truth shows no difference in motion, anchors, height or length"


def _beside(folder: RecordingFolder, others: Sequence[RecordingFolder]) -> Iterator[str]:
    """The anchor that contradicts the other recordings most, another level of motion, and others that are too short."""
    found = []
    for name, pairs in calibration_pairs([folder, *others], KINDS["ranges"]).items():
        errors, here = (pairs.measured - pairs.true)[:, 0], pairs.recording == 0
        if here.any() and not here.all():
            found.append((name, float(np.nanmedian(errors[here])), float(np.nanmedian(errors[~here]))))
    name, own, theirs = max(found, key=lambda x: abs(x[1] - x[2]), default=("", 0.0, 0.0))
    if abs(own - theirs) > CONTRADICTS_M:
        yield f"ranges of anchor {name} have a median error of {own:+.2f} m, in the others {theirs:+.2f} m"
    (own, lasts), *motions = map(_motion, (folder, *others))
    theirs = float(np.nanmedian([acceleration for acceleration, _ in motions]))
    if max(own, theirs) > OTHER_MOTION * min(own, theirs):
        yield f"its tag accelerates with {own:.2g} m/s² (RMS over 1 s), those of the others with {theirs:.2g}"
    if (rest := sum(seconds for _, seconds in motions)) < 0.5 * lasts:
        yield f"it lasts {lasts:.0f} s, and the others together only {rest:.0f} s"


def _motion(folder: RecordingFolder) -> tuple[float, float]:
    """The root mean square of the true acceleration over the floor, m/s², over a second, and the time it spans, s."""
    squares, spans = [np.zeros(0)], [0.0]
    for times, positions in map(folder.paths.of_tag, folder.paths.number):
        grid = np.arange(times[0], times[-1], 1.0)
        places = np.stack([np.interp(grid, times, positions[:, k]) for k in range(2)])
        squares.append((np.diff(places, 2, axis=1) ** 2).sum(axis=0))
        spans.append(float(times[-1] - times[0]))
    joined = np.concatenate(squares)
    return float(np.sqrt(np.nanmean(joined))) if np.isfinite(joined).any() else float("nan"), max(spans)
