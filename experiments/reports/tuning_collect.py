"""Collect the evidence of a tuning run: run both trackers once more over the recordings and look at what they say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version

import numpy as np

from experiments.reports.tuning_data import Descent, ErrorTrack, Score, TunedNumber, TuningEvidence
from trackers.core.estimates import Estimates
from trackers.core.recording import Batch
from trackers.core.tracker import AbstractTracker
from trackers.recordings.tracks import batches
from trackers.recordings.trajectories import Trajectory
from tuning import FitResult
from tuning.consistency import student_t_dof_of
from tuning.diagnostics import Innovations
from tuning.fit import Step
from tuning.identifiability import IdentifiabilityIssue, names_of
from tuning.intervals import Interval
from tuning.metrics import all_metrics
from tuning.parameters import Parameter
from tuning.surface import surface_of

TITLES = {
    "nll": ("Negative log-likelihood per number read", "nats"),
    "rmse": ("RMSE", ""),
    "rmse-3d": ("RMSE in space", ""),
    "state-nll": ("Negative log-likelihood of the truth per row", "nats"),
    "nis-shape": ("NIS: distance from its distribution", "1"),
    "nees-shape": ("NEES: distance from its distribution", "1"),
}
"""Title and unit of every figure, by the names of `tuning.metrics`; without a unit, that of the recordings' truth."""


@dataclass(frozen=True)
class Asked:
    """What was asked of a tuning run, and how long it took; see `TuningEvidence`."""

    command: str
    again: tuple[str, ...]
    tracker: str
    tracker_about: str
    objective: str
    seconds: float
    notes: tuple[str, ...] = ()


def gather(
    asked: Asked,
    result: FitResult,
    training: Sequence[Trajectory],
    held_out: Sequence[Trajectory],
    planar: bool,
    intervals: Mapping[str, Interval],
    identifiability_issues: Sequence[IdentifiabilityIssue] = (),
) -> TuningEvidence:
    """The evidence: figures of both trackers on all trajectories, and what they say on those held out, if any, row by row.

    `training`: the trajectories that were tuned on. `planar`: whether only the place over the floor is estimated.
    `intervals`: 95 %, by label, none where the fit was stopped; `identifiability_issues`: what is not determined. The landscape
    round the optimum takes about as many values as the fit took steps.
    """
    effort, before = result.filter_runs, result.before
    quantity = next(iter(training[0].recording.truth))
    angles = quantity == "direction"
    dimensions = 2 if angles or planar else 3
    # Of the figures `rmse` is the error over the floor, and an error in space has another name.
    goal = "rmse-3d" if asked.objective == "rmse" and dimensions == 3 else asked.objective
    numbers = _numbers(result, intervals, identifiability_issues)
    judged, where = (held_out, "held-out recordings") if held_out else (training, "the recordings tuned on")
    unit, scale = ("°", 180 / np.pi) if angles else ("m", 1.0)
    rows, tracks, comparable = [], [], True
    for tracker in (before, result.tracker):
        seen = [
            (trajectory, one)
            for trajectories, batch in batches(judged)
            for trajectory, one in _each(trajectories, tracker.run(batch))
        ]
        comparable &= all(hasattr(one.mean, quantity) for _, one in seen)
        rows.append(innovations_of([one for _, one in seen], tracker))
        tracks.append(
            {_name(trajectory): _errors(tracker, trajectory, one, quantity, scale) for trajectory, one in seen}
        )
    errors = tuple(
        ErrorTrack(name, times, old, tracks[1][name][1])
        for name, (times, old) in tracks[0].items()
        if np.isfinite(old).any() and np.isfinite(tracks[1][name][1]).any()
    )
    known = (rows[0], rows[1]) if rows[0] is not None and rows[1] is not None else None
    return TuningEvidence(
        command=asked.command,
        again=asked.again,
        tracker=asked.tracker,
        tracker_about=asked.tracker_about,
        objective=goal,
        objective_about=_about(goal, "rad" if angles else "m"),
        training=_recordings(training),
        held_out=_recordings(held_out),
        numbers=numbers,
        scores=(
            *_own_score(goal, result),
            *_scores(
                (before, result.tracker), [_rows(x, comparable) for x in (training, held_out)], quantity, dimensions
            ),
        ),
        descents=_descents(result),
        landscape=surface_of(result, result.uncertainty),
        judged_on=where,
        innovations=known,
        errors=errors,
        error_unit=unit,
        filter_runs=effort,
        seconds=asked.seconds,
        identifiability_issues=tuple(j.text for j in identifiability_issues),
        notes=(*asked.notes, *([JUDGES] if held_out else []), *([] if known else [NO_DISTRIBUTION])),
        provenance=(
            ("trackwright", version("trackwright")),
            ("made", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ),
    )


JUDGES = "The held-out recordings were not fitted, but decided which of the points met is the best and when to stop."
NO_DISTRIBUTION = "The NIS of this tracker has no known distribution, so that it is not drawn."


def _own_score(objective: str, result: FitResult) -> list[Score]:
    """The objective itself where it is a sum, of several or with priors."""
    if objective in TITLES:
        return []
    nan = float("nan")
    return [Score(objective, objective, "1", (result.start_value, result.value), (nan, nan))]


def _about(objective: str, unit: str) -> str:
    if objective not in TITLES:
        return objective
    title, own = TITLES[objective]
    shown = own or unit
    return f"{title if title[:2].isupper() else title[0].lower() + title[1:]}" + (f" ({shown})" if shown != "1" else "")


def _recordings(trajectories: Sequence[Trajectory]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(trajectory.folder.name for trajectory in trajectories))


def _name(trajectory: Trajectory) -> str:
    return ", ".join(
        [
            trajectory.folder.name,
            f"tag {trajectory.tag}",
            *([f"station {trajectory.station}"] if trajectory.station else []),
        ]
    )


def _each(trajectories: Sequence[Trajectory], estimates: Estimates) -> list[tuple[Trajectory, Estimates]]:
    return [(trajectory, estimates[k][: len(trajectory.recording)]) for k, trajectory in enumerate(trajectories)]


def _errors(
    tracker: AbstractTracker, trajectory: Trajectory, one: Estimates, quantity: str, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Times and lengths of the errors, over the floor, or of a direction's two angles; NaN where there is none.

    At the times for which the tracker dates its estimates, with the truth between rows where these are not the rows'.
    """
    rows = trajectory.recording.times
    true, known = trajectory.recording.truth[quantity]
    times, at_valid_time = tracker.at_valid_time(rows, one)
    if not (hasattr(at_valid_time.mean, quantity) and known.any()):
        return times, np.full(len(times), np.nan)
    there = (np.interp(times, rows, known) > 1 - 1e-9) & (times >= rows[0])
    mean = np.stack([np.asarray(x) for x in getattr(at_valid_time.mean, quantity)], axis=1)[:, :2]
    moved = np.stack([np.interp(times, rows[known], true[known, k]) for k in range(2)], axis=1)
    length = scale * np.sqrt(((mean - moved) ** 2).sum(axis=1))
    return times, np.where(there & at_valid_time.usable, length, np.nan)


def innovations_of(every: Sequence[Estimates], tracker: AbstractTracker) -> Innovations | None:
    """The NIS of all rows that have one; None where its distribution isn't known."""
    try:
        nu = student_t_dof_of(tracker)
    except ValueError:
        return None
    heard = [np.isfinite(one.nis) & (one.nis_dof > 0) & one.usable for one in every]
    trajectory = [np.full(int(h.sum()), k) for k, h in enumerate(heard)]
    nis, dof = (
        np.concatenate([getattr(one, name)[h].astype(float) for one, h in zip(every, heard, strict=True)])
        for name in ("nis", "nis_dof")
    )
    return Innovations(nis, dof, np.concatenate(trajectory), None if nu is None else float(np.asarray(nu)))


def _rows(trajectories: Sequence[Trajectory], comparable: bool) -> list[Batch]:
    """The trajectories' rows, without truth where the state has no such quantity: a beam in a flat array's plane has none."""
    rows = [batch for _, batch in batches(trajectories)] if trajectories else []
    return rows if comparable else [batch._replace(truth={}) for batch in rows]


def _scores(
    trackers: Sequence[AbstractTracker], recordings: Sequence[list[Batch]], quantity: str, dimensions: int
) -> tuple[Score, ...]:
    """Every figure that there is, before and after, on the recordings tuned on and on those held out."""
    found = [[all_metrics(t, rows, quantity, dimensions) if rows else {} for t in trackers] for rows in recordings]
    unit = "rad" if quantity == "direction" else "m"
    nan = float("nan")
    scores = []
    for key, (title, own) in TITLES.items():
        pairs = [(old.get(key, nan), new.get(key, nan)) for old, new in found]
        if np.isfinite(pairs).any():
            over = " over the floor" if key == "rmse" and dimensions == 3 else ""
            scores.append(Score(key, title + over, own or unit, pairs[0], pairs[1]))
    return tuple(scores)


def _numbers(
    result: FitResult, intervals: Mapping[str, Interval], identifiability_issues: Sequence[IdentifiabilityIssue]
) -> tuple[TunedNumber, ...]:
    """The table of tuned numbers."""
    doubted = {name for judgement in identifiability_issues for name in judgement.names}
    names = names_of(result.parameters)
    units = [p.example.unit for p in result.parameters for _ in range(int(np.size(p.example.raw)))]
    old, new = (_flat(result.parameters, values) for values in (_own(result)[0].values, result.values))
    nothing = {label: (np.full(np.shape(x), np.nan),) * 2 for label, x in result.values.items()}
    both = {**nothing, **intervals}
    low, high = (_flat(result.parameters, {label: both[label][k] for label in both}) for k in (0, 1))
    finite = np.isfinite(low) & np.isfinite(high)
    # Without any interval nothing is known of how sure the numbers are; with some, one that lacks it is undetermined.
    known = bool(finite.any())
    return tuple(
        TunedNumber(name, unit, float(a), float(b), float(lo) if ok else np.nan, float(hi) if ok else np.nan,
                    False if name in doubted else bool(ok) if known else None)
        for name, unit, a, b, lo, hi, ok in zip(names, units, old, new, low, high, finite, strict=True)
    )  # fmt: skip


def _flat(parameters: Sequence[Parameter], values: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(values[p.label], float)) for p in parameters])


def _own(result: FitResult) -> list[Step]:
    """The way from the tracker's own numbers, which is the first start."""
    return result.starts[0] if result.starts else result.trace


def _descents(result: FitResult) -> tuple[Descent, ...]:
    """The ways of all starts, the one that won first."""
    ways = sorted(result.starts or [result.trace], key=lambda steps: steps is not result.trace)
    return tuple(_descent(f"start {k + 1}", steps, result.parameters) for k, steps in enumerate(ways))


def _descent(name: str, steps: Sequence[Step], parameters: Sequence[Parameter]) -> Descent:
    numbers = np.stack([_flat(parameters, step.values) for step in steps])
    return Descent(name, np.array([step.value for step in steps]), numbers)
