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
from trackers.aoa.rows import beam_trajectories, bearing_trajectories, phase_trajectories
from trackers.baselines.fixes import fix_tracker, singer_tracker
from trackers.baselines.switching import mirror_tracker, switching_tracker
from trackers.baselines.windows import MovingWindow
from trackers.catalogue import TRACKERS, build, tracker_for
from trackers.core.algebra import Vector, diagonal
from trackers.core.checks import BrokenContract, check_motion, check_sensor
from trackers.core.crlb import posterior_bound
from trackers.core.ekf import ExtendedKalman
from trackers.core.errors import UnusableInput
from trackers.core.estimates import Estimates, Status
from trackers.core.filter import AbstractFilter, AbstractSmoothableFilter, Gaussian, Innovation
from trackers.core.imm import InteractingModels, SwitchingMotion
from trackers.core.initial import TrackerState
from trackers.core.inputs import Input, Need
from trackers.core.metrics import bias, consistency, coverage, error_metrics, nees, rmse, time_lost
from trackers.core.motion import (
    AbstractMotion,
    Accelerated,
    ConstantPosition,
    ConstantVelocity,
    GroundMotion,
    Kinematic,
    Placed,
    draw_log_density,
)
from trackers.core.particle.filter import ParticleFilter
from trackers.core.polyline import Polyline
from trackers.core.program_cache import cache_programs
from trackers.core.recording import Batch, Readings, Recording, Row, stack
from trackers.core.rig import Rig, Station, Tag
from trackers.core.sensor import AbstractSensor, Channel, Reading, Residual, independent
from trackers.core.smoother import Smoothed
from trackers.core.start import AbstractStart
from trackers.core.state import Heading, Rotation, wrap
from trackers.core.track_loss import TrackLossPolicy, TrackScorePolicy
from trackers.core.tracker import AbstractTracker, Tracker, filter_batch
from trackers.core.tunable import Covariance, Fraction, Real, Scale, tunables
from trackers.evaluation import Evaluation, evaluate
from trackers.events import events_of
from trackers.exchange.compare import TrajectoryErrors, compare_trajectories
from trackers.exchange.imported import import_frames
from trackers.exchange.poses import PoseTrajectory
from trackers.exchange.trajectory_files import read_trajectory, write_trajectory
from trackers.from_arrays import bearing_recording, fix_recording, phase_recording, range_recording
from trackers.line.grid import GridFilter
from trackers.line.motion import HaltingMotion, LineMotion
from trackers.line.rows import fit_path_truth
from trackers.line.tracker import line_grid_tracker, line_motion, line_tracker
from trackers.line.truth import knot_times
from trackers.mhk.tracker import mhk_tracker
from trackers.parts.fix_rows import fix_trajectories
from trackers.parts.fixes import CorrelatedFixSensor, FixSensor
from trackers.parts.range_rows import range_trajectories
from trackers.parts.ranges import RangeSensor
from trackers.parts.singer import Singer
from trackers.parts.start_nearby import NearbyStart
from trackers.recordings.calibration import AnchorCalibration, Calibration, StationCalibration, TagCalibration
from trackers.recordings.calibration_file import read_calibration, write_calibration
from trackers.recordings.checks import CheckResult, check
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.folder import read_recording as read
from trackers.recordings.folder import read_recordings as read_all
from trackers.recordings.folder import write_recording as write
from trackers.recordings.named_tracker import NamedTracker
from trackers.recordings.tracker_spec import TrackerSpec
from trackers.recordings.tracks import Tracks
from trackers.recordings.trajectories import Trajectory
from trackers.uwb_imu.fusion import range_tracker
from trackers.uwb_imu.inertial import inertial_tracker
from trackers.uwb_imu.multilateration import multilateration_tracker
from trackers.uwb_imu.ranging import double_sided, single_sided
from trackers.uwb_imu.strapdown import PlanarStrapdown, Strapdown
from trackers.uwb_imu.trilateration import trilateration_tracker

__all__ = [
    # recordings on disk and in arrays: start here
    "read",
    "read_all",
    "check",
    "CheckResult",
    "write",
    "RecordingFolder",
    "Rig",
    "Station",
    "Tag",
    "Recording",
    "Readings",
    "fix_recording",
    "range_recording",
    "bearing_recording",
    "phase_recording",
    "Batch",
    "stack",
    "Calibration",
    "StationCalibration",
    "AnchorCalibration",
    "TagCalibration",
    "read_calibration",
    "write_calibration",
    "import_frames",
    "UnusableInput",
    "cache_programs",
    # trackers by name, their estimates, and how good these are
    "tracker_for",
    "build",
    "TRACKERS",
    "NamedTracker",
    "Tracks",
    "Estimates",
    "Status",
    "evaluate",
    "Evaluation",
    "PoseTrajectory",
    "read_trajectory",
    "write_trajectory",
    "compare_trajectories",
    "TrajectoryErrors",
    "events_of",
    "fit_path_truth",
    "error_metrics",
    "rmse",
    "bias",
    "coverage",
    "nees",
    "consistency",
    "time_lost",
    "posterior_bound",
    # trackers ready to run on arrays
    "fix_tracker",
    "singer_tracker",
    "switching_tracker",
    "mirror_tracker",
    "mhk_tracker",
    "MovingWindow",
    "range_tracker",
    "inertial_tracker",
    "multilateration_tracker",
    "trilateration_tracker",
    "line_tracker",
    "line_grid_tracker",
    "bearing_tracker",
    "beam_tracker",
    "in_plane_beam_tracker",
    "cascade_tracker",
    "direct_tracker",
    "Cascade",
    "DelayAndSum",
    "Smoothed",
    # parts of a tracker: filters, starts, track loss
    "AbstractTracker",
    "Tracker",
    "TrackerState",
    "filter_batch",
    "Row",
    "AbstractFilter",
    "AbstractSmoothableFilter",
    "Innovation",
    "ExtendedKalman",
    "Gaussian",
    "ParticleFilter",
    "GridFilter",
    "InteractingModels",
    "TrackLossPolicy",
    "TrackScorePolicy",
    "AbstractStart",
    "BeamStart",
    "NearbyStart",
    "PhaseStart",
    # states and motions
    "Vector",
    "Heading",
    "Rotation",
    "wrap",
    "diagonal",
    "Kinematic",
    "Accelerated",
    "Placed",
    "Beam",
    "InPlaneBeam",
    "AbstractMotion",
    "draw_log_density",
    "ConstantPosition",
    "ConstantVelocity",
    "GroundMotion",
    "Singer",
    "BeamMotion",
    "InPlaneBeamMotion",
    "LineMotion",
    "HaltingMotion",
    "line_motion",
    "Polyline",
    "knot_times",
    "SwitchingMotion",
    "PlanarStrapdown",
    "Strapdown",
    "check_motion",
    # sensors and beamformers
    "AbstractSensor",
    "Channel",
    "Input",
    "Need",
    "Reading",
    "Residual",
    "independent",
    "FixSensor",
    "CorrelatedFixSensor",
    "RangeSensor",
    "BearingSensor",
    "PlanePhases",
    "SphericalPhases",
    "InPlanePhases",
    "single_sided",
    "double_sided",
    "bearing_inputs",
    "recent_points",
    "Grid",
    "delay_and_sum",
    "capon",
    "music",
    "snapshots",
    "strongest",
    "check_sensor",
    "BrokenContract",
    # numbers that can be tuned
    "Scale",
    "Fraction",
    "Real",
    "Covariance",
    "tunables",
    # rows of the tables, for a tracker of one's own by file
    "TrackerSpec",
    "Trajectory",
    "fix_trajectories",
    "range_trajectories",
    "bearing_trajectories",
    "phase_trajectories",
    "beam_trajectories",
]
