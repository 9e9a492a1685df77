"""Parameter recovery: 200 fits to data of each tracker's own model.

Every replicate has new data and starts a factor of ten too high or too low in motion and sensor noise. Checked for
every parameter: the coverage of its 95 % intervals, 89 to 99 % for 200 replicates, by the likelihood's curvature, by
the scatter of rows, and by the wider of both, which `tune` gives; the bias of the unconstrained parameter, at most 3
standard errors; and that no fit ends worse than it began. Systems: A, the beam tracker; B, the grid on a line; C,
ranges; D, MH-K's fusion of fixes with a full covariance. `motion-levels`: whether a fit to a single recording of a
minute finds how much the tag moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from trackwright.experiments.lab.verify.worlds import NEVER_LOST, KnownStart

import trackwright as tw
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen
from trackwright.experiments.lab.validation.own_worlds import own_world
from trackwright.experiments.text.terminal import progress
from trackwright.sim import work_station
from trackwright.trackers.aoa.beam import Beam
from trackwright.trackers.line.fixes import FIXES, FloorFixes
from trackwright.trackers.line.motion import PathState
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.tuning.fitting import FitOptions, fit
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import Parameter, component_names, flatten, select_parameters, with_parameters
from trackwright.tuning.uncertainty import By, unused

REPLICATES = 200
COVERED = (0.89, 0.99)
"""Accepted coverage of 95 % intervals; its standard error over 200 replicates is 1.5 %."""

LEVELS, NEAR = (0.005, 0.02, 0.1, 0.5, 2.0), 1.5
"""Levels of motion, m/s² per √Hz, from a creeping trolley to a hand, and the factor within which fits find them."""

UNBIASED = 3.0
WRONG = np.log(10.0)


def recovery(*systems: str, output: Output = DEFAULTS) -> int:
    """Coverage of intervals and bias of 200 fits to data of each system's own model; 1 if a criterion fails.

    Args:
        systems: of A, B, C and D; all where none is named.
    """
    count = 4 if output.small else REPLICATES
    rows = [row for name in chosen(systems, SYSTEMS) for row in recovered(name, count, seed=7)]
    note = f"Coverage of 95 % intervals by what they are from, and bias in standard errors; {count} fits each."
    output.publish("validation recovery", Table(rows, note=note))
    return int(not all(row["good"] == "yes" for row in rows))


def motion_levels(*, output: Output = DEFAULTS) -> int:
    """Fits of the level of motion to recordings of a minute of system C, from a start that is none of the levels.

    1 if one of twenty is off by more than a factor of `NEAR`.
    """
    system, rows = ranges(), list[Row]()
    tracker = replace(system.tracker, motion=tw.ConstantVelocity(0.3, 3))
    for level in LEVELS:
        world = replace(
            system, tracker=replace(system.tracker, motion=tw.ConstantVelocity(level, 3)), trajectories=1, rows=600
        )
        fits = [
            fit(tracker, tw.stack(recordings), NegativeLogLikelihood(), ("motion.sigma_a",), FitOptions(starts=4))
            for recordings in world.replicates(4 if output.small else REPLICATES, seed=3)
        ]
        ratios = np.array([float(one.values["motion.sigma_a"]) for one in fits]) / level
        near = np.mean(np.abs(np.log(ratios)) < np.log(NEAR))
        rows.append(
            {
                "level": level,
                "median": float(np.median(ratios)),
                "least": float(ratios.min()),
                "largest": float(ratios.max()),
                "near %": 100 * float(near),
            }
        )
    note = f"Fitted by true level of motion; share of recordings within a factor of {NEAR}."
    output.publish("validation motion-levels", Table(rows, note=note))
    return int(any(row["near %"] < 95 for row in rows))


@dataclass(frozen=True)
class System:
    """A tracker with the true parameters, and the tunables to fit.

    Each replicate has `trajectories` of `rows` rows, every `dt` s, all channels seen; `inputs`: of every row.
    """

    tracker: tw.Tracker
    tune: tuple[str, ...]
    channels: int
    trajectories: int
    rows: int
    dt: float
    inputs: dict[str, np.ndarray] = field(default_factory=dict)

    def replicates(self, count: int, seed: int) -> list[list[tw.Recording]]:
        """The trajectories of each replicate, with states and readings drawn from the tracker's own model."""
        (sensor,), n = self.tracker.sensors, self.trajectories
        readings = tw.Readings(np.zeros((self.rows, self.channels)), np.ones((self.rows, self.channels), bool))
        inputs = {key: np.tile(value, (self.rows, 1)) for key, value in self.inputs.items()}
        times = self.dt * np.arange(self.rows)
        geometry = [tw.Recording(times, {sensor: readings}, inputs, name=f"trajectory {k}") for k in range(count * n)]
        drawn = own_world(self.tracker, geometry, seed)[0]
        return [drawn[k * n : (k + 1) * n] for k in range(count)]


def beams() -> System:
    """A: azimuth and elevation from the phases of eight antennas with an unknown common phase."""
    # Within one lobe of the array: a start in another lobe would violate the model.
    start = KnownStart(lambda x: Beam(*x), (0.0,) * 4, (0.01, 0.01, 0.05, 0.05))
    tracker = replace(tw.beam_tracker(work_station().stations["1"], "1", 0.15, 0.2), start=start, track_loss=NEVER_LOST)
    return System(tracker, ("motion.sigma_a", "sensors.*.sigma_p"), 8, 16, 60, 0.05)


def carts() -> System:
    """B: a cart on a bent line, by the grid filter; a coarser grid would bias the noise of the fixes low."""
    line = tw.Polyline([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5]])
    tracker = tw.line_grid_tracker(tw.line.LineMotion(line, 0.04), {FIXES: FloorFixes(0.3)}, 0.03, 0.6, 32)
    start = KnownStart(lambda x: PathState(*x), (0.5, 0.15), (0.15, 0.03))
    known = replace(tracker, start=start, track_loss=NEVER_LOST)
    return System(known, ("motion.sigma_a", "sensors.*.sigma_p"), 2, 16, 32, 0.5)


def ranges() -> System:
    """C: a tag in space and its ranges to six anchors, with normal errors."""
    anchors = np.array([[0, 0, 2.5], [8, 0, 0.3], [8, 6, 2.5], [0, 6, 0.3], [4, 0, 0.5], [4, 6, 2.3]], float)
    count = len(anchors)
    # This many degrees of freedom make Student's t normal, and a skew of 1 makes it symmetric.
    sensor = RangeSensor(count, count, 0.1, positive_skew=1.0, dof=1e4)
    # A spread of half a metre would make the linearisation error 3 cm, which the fit takes for noise.
    start = KnownStart(_moving, (4.0, 3.0, 1.2, 0.0, 0.0, 0.0), (0.1, 0.1, 0.1, 0.3, 0.3, 0.1))
    tracker = tw.Tracker(tw.ConstantVelocity(0.5, 3), {RANGES: sensor}, start, track_loss=NEVER_LOST)
    inputs = {"anchors": anchors.ravel(), "anchor": np.arange(count, dtype=float), "height": np.zeros(())}
    return System(tracker, ("motion.sigma_a", "sensors.*.sigma_r"), count, 8, 60, 0.1, inputs)


def fixes() -> System:
    """D: fixes with correlated errors, as MH-K fuses them."""
    fusion, start = tw.mhk_tracker(sigma_a=0.8).fusion, KnownStart(_moving, (0.0,) * 6, (0.5,) * 6)
    tracker = tw.Tracker(fusion.motion, {FIXES: fusion.sensors[FIXES]}, start, track_loss=NEVER_LOST)
    return System(tracker, ("motion.sigma_a", "sensors.fixes.covariance"), 3, 8, 60, 0.1)


def _moving(x: Sequence[Any]) -> tw.Kinematic:
    return tw.Kinematic(tw.Vector(*x[:3]), tw.Vector(*x[3:]))


SYSTEMS = {"A": beams, "B": carts, "C": ranges, "D": fixes}


def wrong(system: System, replicate: int) -> tw.Tracker:
    """The tracker with process and measurement noise each ten times too small or too large, by replicate."""
    parameters = select_parameters(system.tracker, system.tune)
    corners = [(a, b) for a in (WRONG, -WRONG) for b in (WRONG, -WRONG)]
    motion, sensors = corners[replicate % len(corners)]
    vector, at = flatten(parameters), 0
    for parameter in parameters:
        shape = np.shape(parameter.example.raw)
        size = int(np.prod(shape, dtype=int))
        step = motion if parameter.names[0].startswith("motion.") else sensors
        # For a covariance: the logarithms of its Cholesky factor's diagonal.
        vector[at : at + size] += np.ravel(step * (np.eye(len(parameter.example.raw)) if shape else np.ones(shape)))
        at += size
    made: tw.Tracker = with_parameters(system.tracker, parameters, vector)
    return made


def recovered(name: str, replicates: int, seed: int) -> list[Row]:
    """Fit every replicate; the recovery of each parameter, and whether all criteria hold for it."""
    system = SYSTEMS[name]()
    parameters = select_parameters(system.tracker, system.tune)
    truth = flatten(parameters)
    errors, worse = [], 0
    covered: dict[By, list[np.ndarray]] = {"curvature": [], "scatter": [], "either": []}
    with progress(f"system {name}", replicates) as advance:
        for k, recordings in enumerate(system.replicates(replicates, seed)):
            result = fit(
                wrong(system, k), tw.stack(recordings), NegativeLogLikelihood(), system.tune, FitOptions(starts=4)
            )
            worse += int(result.value > result.start_value)
            assert result.uncertainty is not None
            errors.append(result.vector - truth)
            for way, within in covered.items():
                within.append(_inside(result.uncertainty.intervals(by=way), parameters))
            advance(1)
    error, labels = np.array(errors), component_names(parameters)
    shares = {way: np.mean(within, axis=0) for way, within in covered.items()}
    bias = error.mean(axis=0) / (error.std(axis=0, ddof=1) / np.sqrt(replicates))
    good = [(share >= COVERED[0]) & (share <= COVERED[1]) for share in shares.values()] + [np.abs(bias) < UNBIASED]
    held = np.all(good, axis=0) & (worse == 0)
    return [
        {
            "system": name, "parameter": labels[k], **{f"{way} %": 100 * float(x[k]) for way, x in shares.items()},
            "bias": float(bias[k]), "spread": float(error[:, k].std()), "fits worse": worse,
            "good": "yes" if held[k] else "no",
        }
        for k in np.flatnonzero(~unused(parameters)).tolist()
    ]  # fmt: skip


def _inside(intervals: Mapping[str, tuple[np.ndarray, np.ndarray]], parameters: Sequence[Parameter]) -> np.ndarray:
    """Whether the intervals cover the parameters' values; entry by entry for a matrix."""
    inside = []
    for parameter in parameters:
        low, high = intervals[parameter.label]
        value = np.asarray(parameter.example.value)
        inside.append(np.ravel((low <= value) & (value <= high)))
    return np.concatenate(inside)
