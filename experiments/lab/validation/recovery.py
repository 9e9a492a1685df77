"""Parameter recovery: 200 fits to data of each tracker's own model.

`python -m trackwright.experiments.lab.validation.recovery [SYSTEM …]`. Every replicate has new data and starts a
factor of ten too high or too low in motion and sensor noise. Checked for every parameter: the coverage of its 95 %
intervals, 89 to 99 % for 200 replicates, by the likelihood's curvature, by the scatter of rows, and by the wider of
both, which `tune` gives; the bias of the unconstrained parameter, at most 3 standard errors; and that no fit ends
worse than it began. Systems: A, the beam tracker; B, the grid on a line; C, ranges; D, MH-K's fusion of fixes with a
full covariance.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import trackwright as tw
from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.runtime import set_flags
from trackwright.experiments.text.terminal import progress
from trackwright.sim import work_station
from trackwright.trackers.aoa.beam import Beam
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.line.fixes import FIXES, FloorFixes
from trackwright.trackers.line.motion import PathState
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.tuning.fitting import fit
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import Parameter, component_names, flatten, select_parameters, with_parameters
from trackwright.tuning.uncertainty import By, unused

REPLICATES = 200
COVERED = (0.89, 0.99)
"""Accepted coverage of 95 % intervals; its standard error over 200 replicates is 1.5 %."""

UNBIASED = 3.0
WRONG = np.log(10.0)
NEVER_LOST = tw.TrackLossPolicy(nis_limit=np.inf, max_gap=np.inf)


class Known(tw.AbstractStart):
    """Start at the first row, with the distribution from which the world draws its states."""

    state: Any = eqx.field(static=True)
    mean: tuple[float, ...] = eqx.field(static=True)
    deviations: tuple[float, ...] = eqx.field(static=True)

    def can_start(self, row: Any) -> Any:
        return row.valid

    def candidate(self, sensors: Any, row: Any) -> Any:
        return row.dt

    def belief(self, candidate: Any, row: Any) -> tw.Gaussian:
        zero = jnp.zeros_like(row.dt)
        variances = [zero + d * d for d in self.deviations]
        return tw.Gaussian(self.state([zero + m for m in self.mean]), tw.diagonal(variances, zero))


@dataclass(frozen=True)
class System:
    """A tracker with the true parameters, the tunables to fit, and the simulation of its measurements.

    `read` maps the observation view of n states and a random generator to measurements (n, m). `inputs`: of every row.
    """

    tracker: tw.Tracker
    tune: tuple[str, ...]
    read: Callable[[Any, np.random.Generator], np.ndarray]
    inputs: dict[str, np.ndarray]
    trajectories: int
    rows: int
    dt: float

    def batches(self, replicates: int, seed: int) -> list[Batch]:
        """One batch of trajectories per replicate, with states drawn from the tracker's own start and motion."""
        n, rng = replicates * self.trajectories, np.random.default_rng(seed)
        start: Any = self.tracker.start
        motion = self.tracker.motion
        mean, deviations = np.array(start.mean)[:, None], np.array(start.deviations)[:, None]
        first = mean + deviations * rng.normal(size=(len(mean), n))
        state, values = start.state(list(jnp.asarray(first))), []
        for row in range(self.rows):
            if row:
                w = rng.normal(size=(motion.noise_dimension, n))
                state = motion.step(state, {}, jnp.asarray(self.dt), tw.Vector(*jnp.asarray(w)))
            values.append(self.read(motion.view(state), rng))
        readings, times = np.stack(values, axis=1), self.dt * np.arange(self.rows)
        name = next(iter(self.tracker.sensors))
        inputs = {key: np.tile(value, (self.rows, 1)) for key, value in self.inputs.items()}
        seen = np.ones(readings.shape[1:], bool)
        recordings = [
            tw.Recording(times, {name: tw.Readings(x, seen)}, inputs, name=f"trajectory {k}")
            for k, x in enumerate(readings)
        ]
        m = self.trajectories
        return [tw.stack(recordings[k * m : (k + 1) * m]) for k in range(replicates)]


def beams() -> System:
    """A: azimuth and elevation from the phases of eight antennas with an unknown common phase."""
    station, sigma_p = work_station().stations["1"], 0.2
    assert station.wavelength is not None
    tracker = tw.beam_tracker(station, "1", 0.15, sigma_p)
    wave = 2 * np.pi / station.wavelength * np.asarray(station.antennas).T

    def read(view: Any, rng: np.random.Generator) -> np.ndarray:
        azimuth, elevation = np.asarray(view.azimuth), np.asarray(view.elevation)
        plane = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)
        phases = plane @ wave + rng.uniform(-np.pi, np.pi, (len(plane), 1))
        return np.angle(np.exp(1j * (phases + sigma_p * rng.normal(size=phases.shape))))

    # Within one lobe of the array: a start in another lobe would violate the model.
    start = Known(lambda x: Beam(*x), (0.0,) * 4, (0.01, 0.01, 0.05, 0.05))
    known = replace(tracker, start=start, track_loss=NEVER_LOST)
    return System(known, ("motion.sigma_a", "sensors.*.sigma_p"), read, {}, 16, 60, 0.05)


def _positions(view: Any) -> np.ndarray:
    return np.stack([np.asarray(x) for x in view.position], axis=-1)


def carts() -> System:
    """B: a cart on a bent line, by the grid filter; a coarser grid would bias the noise of the fixes low."""
    line, sigma_p = tw.Polyline([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5]]), 0.3
    tracker = tw.line_grid_tracker(tw.line.LineMotion(line, 0.04), {FIXES: FloorFixes(sigma_p)}, 0.03, 0.6, 32)

    def read(view: Any, rng: np.random.Generator) -> np.ndarray:
        position = _positions(view)[:, :2]
        return position + sigma_p * rng.normal(size=position.shape)

    start = Known(lambda x: PathState(*x), (0.5, 0.15), (0.15, 0.03))
    known = replace(tracker, start=start, track_loss=NEVER_LOST)
    return System(known, ("motion.sigma_a", "sensors.*.sigma_p"), read, {}, 16, 32, 0.5)


def ranges() -> System:
    """C: a tag in space and its ranges to six anchors, with normal errors."""
    anchors = np.array([[0, 0, 2.5], [8, 0, 0.3], [8, 6, 2.5], [0, 6, 0.3], [4, 0, 0.5], [4, 6, 2.3]], float)
    count, sigma_r = len(anchors), 0.1
    # This many degrees of freedom make Student's t normal, and a skew of 1 makes it symmetric.
    sensor = RangeSensor(count, count, sigma_r, positive_skew=1.0, dof=1e4)

    def read(view: Any, rng: np.random.Generator) -> np.ndarray:
        position = _positions(view)
        distance = np.linalg.norm(position[:, None] - anchors, axis=-1)
        return distance + sigma_r * rng.normal(size=distance.shape)

    # A spread of half a metre would make the linearisation error 3 cm, which the fit takes for noise.
    start = Known(_moving, (4.0, 3.0, 1.2, 0.0, 0.0, 0.0), (0.1, 0.1, 0.1, 0.3, 0.3, 0.1))
    tracker = tw.Tracker(tw.ConstantVelocity(0.5, 3), {RANGES: sensor}, start, track_loss=NEVER_LOST)
    inputs = {"anchors": anchors.ravel(), "anchor": np.arange(count, dtype=float), "height": np.zeros(())}
    return System(tracker, ("motion.sigma_a", "sensors.*.sigma_r"), read, inputs, 8, 60, 0.1)


def fixes() -> System:
    """D: fixes with correlated errors, as MH-K fuses them."""
    fusion = tw.mhk_tracker(sigma_a=0.8).fusion
    sensor = fusion.sensors[FIXES]
    factor = np.linalg.cholesky(np.array(sensor.covariance.value))  # type: ignore[attr-defined]

    def read(view: Any, rng: np.random.Generator) -> np.ndarray:
        position = _positions(view)
        return position + rng.normal(size=position.shape) @ factor.T

    start = Known(_moving, (0.0,) * 6, (0.5,) * 6)
    tracker = tw.Tracker(fusion.motion, {FIXES: sensor}, start, track_loss=NEVER_LOST)
    return System(tracker, ("motion.sigma_a", "sensors.fixes.covariance"), read, {}, 8, 60, 0.1)


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


def recovered(name: str, system: System, replicates: int, seed: int) -> bool:
    """Fit every replicate, print the results, and return whether all criteria hold."""
    batches, began = system.batches(replicates, seed), time.perf_counter()
    parameters = select_parameters(system.tracker, system.tune)
    truth = flatten(parameters)
    errors, worse = [], 0
    covered: dict[By, list[np.ndarray]] = {"curvature": [], "scatter": [], "either": []}
    with progress(f"system {name}", replicates) as advance:
        for k, batch in enumerate(batches):
            result = fit(wrong(system, k), batch, NegativeLogLikelihood(), system.tune, starts=4)
            worse += int(result.value > result.start_value)
            assert result.uncertainty is not None
            errors.append(result.vector - truth)
            for way, within in covered.items():
                within.append(_inside(result.uncertainty.intervals(by=way), parameters))
            advance(1)
    error, making, labels = np.array(errors), ~unused(parameters), component_names(parameters)
    shares = {way: np.mean(within, axis=0) for way, within in covered.items()}
    bias = error.mean(axis=0) / (error.std(axis=0, ddof=1) / np.sqrt(replicates))
    good = [(share >= COVERED[0]) & (share <= COVERED[1]) for share in shares.values()] + [np.abs(bias) < UNBIASED]
    seconds = time.perf_counter() - began
    print(f"system {name}: {replicates} fits in {seconds:.0f} s, {worse} ended worse than they began")
    for k in np.flatnonzero(making).tolist():
        by = ", ".join(f"{100 * share[k]:.1f} % by {way}" for way, share in shares.items())
        print(
            f"  {labels[k]:32s} coverage of 95 % intervals {by}   bias {bias[k]:+.2f} standard errors   "
            f"spread {error[:, k].std():.4f}",
            flush=True,
        )
    return bool(np.all(good, axis=0)[making].all()) and worse == 0


def _inside(intervals: Mapping[str, tuple[np.ndarray, np.ndarray]], parameters: Sequence[Parameter]) -> np.ndarray:
    """Whether the intervals cover the parameters' values; entry by entry for a matrix."""
    inside = []
    for parameter in parameters:
        low, high = intervals[parameter.label]
        value = np.asarray(parameter.example.value)
        inside.append(np.ravel((low <= value) & (value <= high)))
    return np.concatenate(inside)


def main(systems: tuple[str, ...] = ()) -> int:
    """Fit all replicates of the systems and print the recovery of their parameters; 1 if a system fails.

    Args:
        systems: of A, B, C and D; all where none is named.
    """
    set_flags()
    unknown = [name for name in systems if name not in SYSTEMS]
    if unknown:
        print(f"unknown system {unknown[0]}: expected some of {', '.join(SYSTEMS)}", file=sys.stderr)
        return 2
    good = [recovered(name, SYSTEMS[name](), REPLICATES, seed=7) for name in systems or SYSTEMS]
    return int(not all(good))


if __name__ == "__main__":
    run_alone(main, "python -m trackwright.experiments.lab.validation.recovery")
