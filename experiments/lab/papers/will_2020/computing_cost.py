"""Computing cost of delay-and-sum and of the EKF: paper A, section 4.1.

Costs are operations of a row as XLA counts them before it optimises: the same on every machine. The 28 differences,
whose 28 × 28 matrix the paper inverts, are compressed to 2 channels with the same estimates. The start of a track, one
search by the beamformer, is not counted.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.declared import built
from trackwright.experiments.lab.papers.will_2020._work_stand import BEAM, NUMBERS, RADIUS, recorded, stand
from trackwright.experiments.text.expectations import listed
from trackwright.trackers.aoa.beam import Beam, DelayAndSum, beam_tracker
from trackwright.trackers.aoa.beamformer import Grid, delay_and_sum, strongest
from trackwright.trackers.aoa.rows import PHASES
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.model.algebra import diagonal
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import Reading

RESOLUTIONS = {"DAS, 1.2 deg": 1.2, "DAS, 0.6 deg": 0.6, "DAS, 0.3 deg": 0.3}


def _grid(station: Station, resolution: float) -> Grid:
    """The beamformer's grid with a resolution in degrees."""
    return Grid.of(station, resolution=np.deg2rad(resolution))


def _searching(resolution: float) -> mc.TrackerConfig:
    """The beamformer on such a grid."""
    about = spec_of("das").about
    return built("das", about, lambda t, _: DelayAndSum(_grid(t.folder.rig.stations[t.station], resolution), PHASES))


def operations(function: Callable[..., Any], *arguments: Any) -> int:
    """The arithmetic operations and elementary functions of a call, as XLA counts them before it optimises."""
    counts: Any = jax.jit(function).lower(*arguments).cost_analysis()
    return round(counts["flops"] + counts["transcendentals"])


def search_operations(station: Station, resolution: float) -> int:
    """Those of a row of the beamformer on a grid with a resolution in degrees."""
    grid = _grid(station, resolution)
    antennas = len(grid.cosine)

    def row(phases: Any, seen: Any) -> Any:
        return strongest(grid, delay_and_sum(grid, phases, seen))

    return operations(row, jnp.zeros(antennas), jnp.ones(antennas, bool))


def filter_operations(station: Station) -> int:
    """Those of a row of the EKF: prediction and update."""
    tracker, zero = beam_tracker(station, PHASES), jnp.zeros(())
    belief = Gaussian(Beam(zero, zero, zero, zero), diagonal([zero + 1.0] * 4, zero))
    antennas = 0 if station.antennas is None else len(station.antennas)

    def row(belief: Gaussian, phases: list[Any], seen: list[Any], dt: Any) -> Any:
        before = tracker.filter.predict(belief, tracker.motion, {}, dt)
        return tracker.filter.update(before, tracker.motion, tracker.sensors[PHASES], Reading(phases, seen), {})

    return operations(row, belief, [zero] * antennas, [zero == zero] * antennas, zero)


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The paper's conclusions on both costs."""
    station = next(iter(stand(NUMBERS, RADIUS).stations.values()))
    effort = {"EKF": filter_operations(station)}
    effort |= {name: search_operations(station, resolution) for name, resolution in RESOLUTIONS.items()}
    rmse = {t: np.rad2deg(results.value("rmse_direction_rad", "stand", t).value) for t in results.study.trackers}
    coarse, usual, fine = (effort[name] for name in RESOLUTIONS)
    says = "the EKF costs less than a beamformer of 10,000 hypotheses"
    how = f"operations of a row: {listed(effort, '{:,}')}; {usual / effort['EKF']:.0f} times less"
    yield mc.Conclusion(says, effort["EKF"] < usual, how, mc.PREDICTED)
    says = "the beamformer's effort grows with the resolution of its search space, the EKF has none"
    how = f"operations at half the step {fine / usual:.2f} times, at twice the step {usual / coarse:.2f} "
    how += "times less: in proportion to the number of hypotheses"
    yield mc.Conclusion(says, 3.5 * coarse < usual < fine / 3.5, how, mc.DERIVED)
    says = "no finer search makes the beamformer as accurate as the EKF"
    yield mc.Conclusion(says, rmse["DAS, 0.3 deg"] > rmse["EKF"], listed(rmse, "{:.2f} deg"), mc.DERIVED)


STUDY = mc.Study(
    name="computing-cost",
    about="What does a direction cost, by delay-and-sum on finer and coarser grids and by the EKF?",
    worlds={"stand": mc.World(recorded, {"radius": RADIUS})},
    trackers={"EKF": BEAM} | {name: _searching(r) for name, r in RESOLUTIONS.items()},
    runs=40,
    metrics=("us_per_row", "rmse_direction_rad", "median_direction_rad"),
    expected=expected,
)
