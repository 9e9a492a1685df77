"""Computing cost of delay-and-sum and of the EKF: paper A, section 4.1.

Times hold for this machine and a batch of trajectories, without compiling; the paper compares their ratios. The paper's
filter inverts a 28 × 28 matrix. Here the 28 differences are compressed to 2 channels, which makes the EKF cheaper with
the same estimates.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from experiments.monte_carlo import Conclusion, ExpectedResult, Results, Study, TrackerConfig, World
from experiments.papers.will_2020._work_stand import beam, recorded
from experiments.papers.will_2020.fit_figure_8 import radius
from experiments.reports.wording import listed
from trackers.aoa.beamformer import Grid
from trackers.aoa.das import DelayAndSum
from trackers.aoa.rows import PHASES, TRACKERS
from trackers.core.tracker import AbstractTracker
from trackers.recordings.tracker_spec import TrackerSpec
from trackers.recordings.trajectories import Trajectory

RESOLUTIONS = {"DAS, 1.2 deg": 1.2, "DAS, 0.6 deg": 0.6, "DAS, 0.3 deg": 0.3}


def _searching(resolution: float) -> TrackerSpec:
    """The beamformer on a grid with a resolution in degrees."""

    def build(trajectory: Trajectory, planar: bool) -> AbstractTracker:
        station = trajectory.folder.rig.stations[trajectory.station]
        return DelayAndSum(Grid.of(station, resolution=np.deg2rad(resolution)), PHASES)

    return dataclasses.replace(TRACKERS["das"], build=build)


def expected(results: Results) -> list[ExpectedResult | Conclusion]:
    """The paper's conclusions on both costs."""
    us = {t: results.value("us_per_row", "stand", t).value for t in results.study.trackers}
    rmse = {t: np.rad2deg(results.value("rmse_direction_rad", "stand", t).value) for t in results.study.trackers}
    coarse, usual, fine = (us[name] for name in RESOLUTIONS)
    return [
        Conclusion("the EKF costs less than a beamformer of 10,000 hypotheses", us["EKF"] < usual,
                   f"a row: {listed(us, '{:.2f} us')}; {usual / us['EKF']:.0f} times less"),
        Conclusion("the beamformer's effort grows with the resolution of its search space, the EKF has none",
                   coarse < usual < fine and fine > 2 * usual,
                   f"at half the step {fine / usual:.1f} times, at twice the step {usual / coarse:.1f} times less"),
        Conclusion("no finer search makes the beamformer as accurate as the EKF", rmse["DAS, 0.3 deg"] > rmse["EKF"],
                   listed(rmse, "{:.2f} deg")),
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
