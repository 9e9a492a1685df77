"""Trackers: everything that turns recordings of an installation into estimates. The public names stand here."""

from trackers.aoa.beam import (
    Beam,
    BeamMotion,
    BeamStart,
    InPlaneBeam,
    InPlaneBeamMotion,
    beam_tracker,
    in_plane_beam_tracker,
)
from trackers.aoa.beamformer import Grid, capon, delay_and_sum, music, snapshots, strongest
from trackers.aoa.cascade import Cascade, cascade_tracker
from trackers.aoa.das import DelayAndSum
from trackers.aoa.direct import PhaseStart, direct_tracker
from trackers.aoa.fusion import BearingSensor, bearing_inputs, bearing_tracker
from trackers.aoa.phases import InPlanePhases, PlanePhases, SphericalPhases
from trackers.aoa.rays import recent_points
from trackers.baselines.fixes import fix_tracker, singer_tracker
from trackers.baselines.switching import mirror_tracker, switching_tracker
from trackers.baselines.windows import MovingWindow
from trackers.core.algebra import Vector, diagonal
from trackers.core.checks import BrokenContract, check_motion, check_sensor
from trackers.core.crlb import posterior_bound
from trackers.core.ekf import ExtendedKalman, Gaussian
from trackers.core.estimates import Estimates, Status
from trackers.core.imm import InteractingModels, SwitchingMotion
from trackers.core.metrics import bias, consistency, coverage, error_metrics, nees, rmse, time_lost
from trackers.core.motion import (
    AbstractMotion,
    Accelerated,
    ConstantPosition,
    ConstantVelocity,
    GroundMotion,
    Kinematic,
    Placed,
)
from trackers.core.particle.filter import ParticleFilter
from trackers.core.polyline import Polyline
from trackers.core.recording import Batch, Readings, Recording, Row, stack
from trackers.core.rig import Rig, Station, Tag
from trackers.core.rts import Smoothed
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, independent
from trackers.core.start import AbstractStart
from trackers.core.state import Heading, Rotation, wrap
from trackers.core.track_loss import TrackLossPolicy
from trackers.core.tracker import AbstractTracker, Tracker
from trackers.core.tunable import Covariance, Fraction, Real, Scale, tunables
from trackers.line.grid import GridFilter
from trackers.line.motion import HaltingMotion, LineMotion
from trackers.line.tracker import line_grid_tracker, line_motion, line_tracker
from trackers.line.truth import knot_times
from trackers.mhk.tracker import mhk_tracker
from trackers.parts.fixes import CorrelatedFixSensor, FixSensor
from trackers.parts.ranges import RangeSensor
from trackers.parts.singer import Singer
from trackers.parts.start_nearby import NearbyStart
from trackers.uwb_imu.fusion import range_tracker
from trackers.uwb_imu.inertial import inertial_tracker
from trackers.uwb_imu.multilateration import multilateration_tracker
from trackers.uwb_imu.ranging import double_sided, single_sided
from trackers.uwb_imu.strapdown import PlanarStrapdown, Strapdown
from trackers.uwb_imu.trilateration import trilateration_tracker

__all__ = [
    "AbstractMotion",
    "AbstractSensor",
    "AbstractStart",
    "AbstractTracker",
    "Accelerated",
    "Batch",
    "Beam",
    "BeamMotion",
    "BeamStart",
    "BearingSensor",
    "BrokenContract",
    "Cascade",
    "Channel",
    "ConstantPosition",
    "ConstantVelocity",
    "CorrelatedFixSensor",
    "Covariance",
    "DelayAndSum",
    "Estimates",
    "ExtendedKalman",
    "FixSensor",
    "Fraction",
    "Gaussian",
    "Grid",
    "GridFilter",
    "GroundMotion",
    "HaltingMotion",
    "Heading",
    "InPlaneBeam",
    "InPlaneBeamMotion",
    "InPlanePhases",
    "InteractingModels",
    "Kinematic",
    "LineMotion",
    "MovingWindow",
    "NearbyStart",
    "ParticleFilter",
    "PhaseStart",
    "Placed",
    "PlanarStrapdown",
    "PlanePhases",
    "Polyline",
    "RangeSensor",
    "Reading",
    "Readings",
    "Real",
    "Recording",
    "Residual",
    "Rig",
    "Rotation",
    "Row",
    "Scale",
    "Singer",
    "Smoothed",
    "SphericalPhases",
    "Station",
    "Status",
    "Strapdown",
    "SwitchingMotion",
    "Tag",
    "TrackLossPolicy",
    "Tracker",
    "Vector",
    "beam_tracker",
    "bearing_inputs",
    "bearing_tracker",
    "bias",
    "capon",
    "cascade_tracker",
    "check_motion",
    "check_sensor",
    "consistency",
    "coverage",
    "delay_and_sum",
    "diagonal",
    "direct_tracker",
    "double_sided",
    "error_metrics",
    "fix_tracker",
    "in_plane_beam_tracker",
    "independent",
    "inertial_tracker",
    "knot_times",
    "line_grid_tracker",
    "line_motion",
    "line_tracker",
    "mhk_tracker",
    "mirror_tracker",
    "multilateration_tracker",
    "music",
    "nees",
    "posterior_bound",
    "range_tracker",
    "recent_points",
    "rmse",
    "singer_tracker",
    "single_sided",
    "snapshots",
    "stack",
    "strongest",
    "switching_tracker",
    "time_lost",
    "trilateration_tracker",
    "tunables",
    "wrap",
]
