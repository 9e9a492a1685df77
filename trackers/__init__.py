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
from trackers.core.algebra import Vector, diagonal
from trackers.core.bound import posterior_bound
from trackers.core.contract import BrokenContract, check_motion, check_sensor
from trackers.core.ekf import ExtendedKalman, Gaussian
from trackers.core.estimates import Estimates, Status
from trackers.core.metrics import bias, consistency, coverage, error_figures, nees, rmse, time_lost
from trackers.core.motion import (
    AbstractMotion,
    Accelerated,
    ConstantPosition,
    ConstantVelocity,
    GroundMotion,
    Kinematic,
    Placed,
)
from trackers.core.nearby import NearbyStart
from trackers.core.recording import Batch, Readings, Recording, stack
from trackers.core.rig import Rig, Station, Tag
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, independent
from trackers.core.singer import Singer
from trackers.core.state import Heading, Rotation, wrap
from trackers.core.tracker import AbstractStart, AbstractTracker, LossPolicy, Row, Tracker
from trackers.core.tunable import Covariance, Fraction, Real, Scale, tunables

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
    "Covariance",
    "DelayAndSum",
    "Estimates",
    "ExtendedKalman",
    "Fraction",
    "Gaussian",
    "Grid",
    "GroundMotion",
    "Heading",
    "InPlaneBeam",
    "InPlaneBeamMotion",
    "InPlanePhases",
    "Kinematic",
    "LossPolicy",
    "NearbyStart",
    "PhaseStart",
    "Placed",
    "PlanePhases",
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
    "SphericalPhases",
    "Station",
    "Status",
    "Tag",
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
    "error_figures",
    "in_plane_beam_tracker",
    "independent",
    "music",
    "nees",
    "posterior_bound",
    "recent_points",
    "rmse",
    "snapshots",
    "stack",
    "strongest",
    "time_lost",
    "tunables",
    "wrap",
]
