"""What delay-and-sum costs against the EKF, and by what it grows: paper A, section 4.1.

Times are of this machine and of a batch of trajectories, compiling left out; their ratios are what the paper talks
about. The paper's own filter inverts a 28 x 28 matrix; here the 28 differences are 8 phases with a 2 x 2 solution, so
that the EKF is cheaper than the paper's while its estimates are the same.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from experiments.monte_carlo import Conclusion, ExpectedResult, Results, Study, TrackerConfig, World
from experiments.papers.will_2020._work_stand import beam, recorded
from experiments.papers.will_2020.fit_figure_8 import radius
from trackers.aoa.beamformer import Grid
from trackers.aoa.das import DelayAndSum
from trackers.aoa.rows import PHASES, TRACKERS
from trackers.core.tracker import AbstractTracker
from trackers.recordings.tracker_spec import TrackerSpec
from trackers.recordings.trajectories import Trajectory

RESOLUTIONS = {"DAS, 1.2 deg": 1.2, "DAS, 0.6 deg": 0.6, "DAS, 0.3 deg": 0.3}


def _searching(resolution: float) -> TrackerSpec:
    """The beamformer on a grid of this resolution, degrees."""

    def build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
        station = trajectory.folder.rig.stations[trajectory.station]
        return DelayAndSum(Grid.of(station, resolution=np.deg2rad(resolution)), PHASES)

    return dataclasses.replace(TRACKERS["das"], build=build)


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The paper's statements on the effort of both."""
    us = {t: results.value("us_per_row", "stand", t).value for t in results.study.trackers}
    rmse = {t: np.rad2deg(results.value("rmse_direction_rad", "stand", t).value) for t in results.study.trackers}
    coarse, usual, fine = (us[name] for name in RESOLUTIONS)
    told = ", ".join(f"{t} {v:.2f} us" for t, v in us.items())
    return [
        Conclusion("the EKF costs less than a beamformer of 10,000 hypotheses", us["EKF"] < usual,
                   f"a row: {told}; {usual / us['EKF']:.0f} times less"),
        Conclusion("the beamformer's effort grows with the resolution of its search space, the EKF has none",
                   coarse < usual < fine and fine > 2 * usual,
                   f"at half the step {fine / usual:.1f} times, at twice the step {usual / coarse:.1f} times less"),
        Conclusion("no finer search makes the beamformer as accurate as the EKF", rmse["DAS, 0.3 deg"] > rmse["EKF"],
                   ", ".join(f"{t} {v:.2f} deg" for t, v in rmse.items())),
    ]  # fmt: skip


STUDY = Study(
    name="computing-cost",
    about="What does a direction cost, by delay-and-sum on finer and coarser grids and by the EKF?",
    worlds={"stand": World(recorded, {"radius": radius()})},
    trackers={"EKF": beam()} | {name: TrackerConfig(_searching(r)) for name, r in RESOLUTIONS.items()},
    runs=40,
    metrics=("us_per_row", "rmse_direction_rad", "median_direction_rad"),
    expected=expected,
)
