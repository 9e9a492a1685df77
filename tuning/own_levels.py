"""Noise levels of a recording by its own likelihood, for whoever has no truth: `track --fit`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trackwright.trackers.core.errors import UnusableInput, significant
from trackwright.trackers.core.model.tunable import role_of
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.fitting import FitOptions, fit
from trackwright.tuning.parameters import tuned_by_default
from trackwright.tuning.weight import rows_and_inflation

LEAST_GAIN = 2.0  # nats of the posterior below which a recording tells nothing against the levels that it is run at

# Ratio of the levels of errors that last and those that do not from which on the first pass for motion. It is larger on
# the real ranges and bearings used for development, 1.7 and less on two, and smaller with white noise.
LASTING = 1.5
INFLATION = 3.0  # rows with the information of one, at the fitted levels, from which errors last (without biases)
STEPS, STARTS = 30, 3  # from the defaults alone white ranges of level anchors end with lasting errors and heights off
BIAS = "sigma_bias"
MOTION = "errors that last look like motion; calibrate, or tune with truth"


@dataclass(frozen=True)
class OwnLevels:
    """The tracker at the levels of a recording, or as it was; `line`: what was taken, or why nothing was."""

    tracker: NamedTracker
    line: str


def fitted(tracker: NamedTracker, recording: RecordingFolder) -> OwnLevels:
    """The tracker at the noise levels and shapes of errors that are most probable by a recording's own readings.

    Their prior is in `tuning.parameters`; truth is not used, and values that the tracker was given stay. All stay
    where the readings tell nothing against them, where the likelihood cannot be maximised, and where errors last: where
    their fitted level is above the level of others, or innovations are correlated at the fitted levels. Errors
    that last look like motion, from which no likelihood of readings tells them.
    """
    try:
        tune = tuned_by_default(tracker.only_batch(recording).tracker, needs_truth=False)
        # A bias is as large when the track starts as later.
        tune = tuple(f"tied:*.{BIAS}" if name == f"motion.{BIAS}" else name for name in tune)
        result = fit(tracker, recording, "nll", tune, FitOptions(steps=STEPS, starts=STARTS, frozen=(*tracker.values,)))
        problem, vector = result.problem, result.vector
        gain = (result.start_value - result.value) * problem.nats_per_unit(result.evaluation.sums[0])
        rows, inflation = rows_and_inflation(problem, vector)
    except (UnusableInput, ValueError, FloatingPointError) as problem:
        return OwnLevels(tracker, f"{recording.name}: levels stay: {problem}")
    before, now = tracker.tunables, result.tracker.tunables
    bias, noise = (
        [np.max(x.value) for x in now.values() if role_of(x) == role] for role in ("bias noise", "measurement noise")
    )
    against = ""
    if not gain >= LEAST_GAIN:
        against = f"the readings tell nothing against them ({gain:.1f} nats for others)"
    elif inflation >= INFLATION:
        against = f"{rows} rows carry the information of {rows / inflation:.0f}: {MOTION}"
    elif max(bias, default=0.0) > LASTING * max(noise, default=np.inf):
        against = f"errors of the readings that last are {max(bias) / max(noise):.1f} times those that do not: {MOTION}"
    if against:
        return OwnLevels(tracker, f"{recording.name}: levels stay: {against}")
    names = [name for p in result.parameters for name in p.names]
    moved = [f"{n} {_short(before[n].value)} → {_short(now[n].value)} {now[n].unit}".removesuffix(" 1") for n in names]
    return OwnLevels(result.tracker, f"{recording.name}: fitted to its readings: {', '.join(moved)}")


def _short(values: object) -> str:
    return " ".join(significant(x, 3) for x in np.ravel(np.asarray(values, float)))
