"""Parameter recovery: 200 fits to data of each tracker's own model, from starts a factor of ten off.

For every parameter: the coverage of its 95 % intervals, 0.89 to 0.99 for 200 replicates, by the likelihood's curvature,
by the scatter of rows, and by the wider of both, which `tune` gives; its bias in standard errors, at most 3; and how
many fits end worse than they began, none.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation.own_worlds import NEVER_LOST, KnownStart, own_world
from trackwright.sim import work_station
from trackwright.trackers.aoa.beam import Beam
from trackwright.trackers.parts.fixes import FIXES
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.tuning.fitting import FitOptions, FitResult, fit
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import component_names, flatten, select_parameters, with_parameters
from trackwright.tuning.uncertainty import By, unused

REPLICATES, SEED = 200, 7
COVERED, UNBIASED = (0.89, 0.99), 3.0
"""Accepted coverage, whose standard error over 200 replicates is 1.5 %, and bias in standard errors."""

WAYS: tuple[By, ...] = ("curvature", "scatter", "either")


def cases() -> Iterator[Case]:
    """Each parameter of each system."""
    for name, make in SYSTEMS.items():
        system = make()
        parameters = select_parameters(system.tracker, system.tune)
        labels = component_names(parameters)
        for k in np.flatnonzero(~unused(parameters)).tolist():
            yield Case("own model", name, labels[k], partial(recovered, name, k), SEED)


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
    """Azimuth and elevation from the phases of eight antennas with an unknown common phase."""
    # Within one lobe of the array: a start in another lobe would violate the model.
    start = KnownStart(lambda x: Beam(*x), (0.0,) * 4, (0.01, 0.01, 0.05, 0.05))
    tracker = replace(tw.beam_tracker(work_station().stations["1"], "1", 0.15, 0.2), start=start, track_loss=NEVER_LOST)
    return System(tracker, ("motion.sigma_a", "sensors.*.sigma_p"), 8, 16, 60, 0.05)


def ranges() -> System:
    """A tag in space and its ranges to six anchors, with normal errors."""
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
    """Fixes with correlated errors, as MH-K fuses them."""
    fusion, start = tw.mhk_tracker(sigma_a=0.8).fusion, KnownStart(_moving, (0.0,) * 6, (0.5,) * 6)
    tracker = tw.Tracker(fusion.motion, {FIXES: fusion.sensors[FIXES]}, start, track_loss=NEVER_LOST)
    return System(tracker, ("motion.sigma_a", "sensors.fixes.covariance"), 3, 8, 60, 0.1)


def _moving(x: Sequence[Any]) -> tw.Kinematic:
    return tw.Kinematic(tw.Vector(*x[:3]), tw.Vector(*x[3:]))


SYSTEMS = {"beam": beams, "ranges": ranges, "fixes": fixes}


def wrong(system: System, replicate: int) -> tw.Tracker:
    """The tracker with process and measurement noise each ten times too small or too large, by replicate."""
    parameters = select_parameters(system.tracker, system.tune)
    corners = [(a, b) for a in (1, -1) for b in (1, -1)]
    motion, sensors = np.log(10.0) * np.array(corners[replicate % len(corners)])
    parts = []
    for parameter in parameters:
        step, raw = motion if parameter.names[0].startswith("motion.") else sensors, np.asarray(parameter.example.raw)
        # For a covariance: the logarithms of its Cholesky factor's diagonal.
        parts.append(np.ravel(step * (np.eye(len(raw)) if raw.ndim else np.ones(()))))
    made: tw.Tracker = with_parameters(system.tracker, parameters, flatten(parameters) + np.concatenate(parts))
    return made


@lru_cache(maxsize=1)
def fits(name: str) -> tuple[FitResult, ...]:
    """The fits to every replicate of a system."""
    system = SYSTEMS[name]()
    return tuple(
        fit(wrong(system, k), tw.stack(drawn), NegativeLogLikelihood(), system.tune, FitOptions(starts=4))
        for k, drawn in enumerate(system.replicates(REPLICATES, SEED))
    )


def recovered(name: str, component: int) -> Figures:
    """The recovery of one number over all fits to a system, and whether all criteria hold."""
    system, results = SYSTEMS[name](), fits(name)
    parameters = select_parameters(system.tracker, system.tune)
    error = np.array([result.vector for result in results])[:, component] - flatten(parameters)[component]
    covered: dict[str, float] = {
        way: float(np.mean([_inside(one, parameters, way)[component] for one in results])) for way in WAYS
    }
    bias = float(error.mean() / (error.std(ddof=1) / np.sqrt(len(error))))
    worse = sum(result.value > result.start_value for result in results)
    good = all(COVERED[0] <= share <= COVERED[1] for share in covered.values()) and abs(bias) < UNBIASED and not worse
    return {"fits": len(results), **covered, "bias": bias, "worse": worse, "good": "yes" if good else "no"}


def _inside(result: FitResult, parameters: Sequence[Any], way: By) -> np.ndarray:
    """Whether the intervals cover the true values; entry by entry for a matrix."""
    assert result.uncertainty is not None
    intervals = result.uncertainty.intervals(by=way)
    parts = [(*intervals[p.label], np.asarray(p.example.value)) for p in parameters]
    return np.concatenate([np.ravel((low <= value) & (value <= high)) for low, high, value in parts])
