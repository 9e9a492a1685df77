from trackers.aoa.beam import Beam as Beam
from trackers.aoa.beam import BeamMotion as BeamMotion
from trackers.aoa.beam import BeamStart as BeamStart
from trackers.aoa.beam import InPlaneBeam as InPlaneBeam
from trackers.aoa.beam import InPlaneBeamMotion as InPlaneBeamMotion
from trackers.aoa.beam import beam_tracker as beam_tracker
from trackers.aoa.beam import in_plane_beam_tracker as in_plane_beam_tracker
from trackers.aoa.beamformer import Grid as Grid
from trackers.aoa.beamformer import capon as capon
from trackers.aoa.beamformer import delay_and_sum as delay_and_sum
from trackers.aoa.beamformer import music as music
from trackers.aoa.beamformer import snapshots as snapshots
from trackers.aoa.beamformer import strongest as strongest
from trackers.aoa.cascade import Cascade as Cascade
from trackers.aoa.cascade import cascade_tracker as cascade_tracker
from trackers.aoa.das import DelayAndSum as DelayAndSum
from trackers.aoa.direct import PhaseStart as PhaseStart
from trackers.aoa.direct import direct_tracker as direct_tracker
from trackers.aoa.fusion import BearingSensor as BearingSensor
from trackers.aoa.fusion import bearing_inputs as bearing_inputs
from trackers.aoa.fusion import bearing_tracker as bearing_tracker
from trackers.aoa.phases import InPlanePhases as InPlanePhases
from trackers.aoa.phases import PlanePhases as PlanePhases
from trackers.aoa.phases import SphericalPhases as SphericalPhases
from trackers.aoa.rays import recent_points as recent_points
from trackers.aoa.rows import beam_trajectories as beam_trajectories
from trackers.aoa.rows import bearing_trajectories as bearing_trajectories
from trackers.aoa.rows import phase_trajectories as phase_trajectories
from trackers.baselines.fixes import fix_tracker as fix_tracker
from trackers.baselines.fixes import singer_tracker as singer_tracker
from trackers.baselines.switching import mirror_tracker as mirror_tracker
from trackers.baselines.switching import switching_tracker as switching_tracker
from trackers.baselines.windows import MovingWindow as MovingWindow
from trackers.catalogue import TRACKERS as TRACKERS
from trackers.catalogue import build as build
from trackers.catalogue import tracker_for as tracker_for
from trackers.core.data.estimates import Estimates as Estimates
from trackers.core.data.estimates import Status as Status
from trackers.core.data.metrics import bias as bias
from trackers.core.data.metrics import consistency as consistency
from trackers.core.data.metrics import coverage as coverage
from trackers.core.data.metrics import error_metrics as error_metrics
from trackers.core.data.metrics import nees as nees
from trackers.core.data.metrics import rmse as rmse
from trackers.core.data.metrics import time_lost as time_lost
from trackers.core.data.recording import Batch as Batch
from trackers.core.data.recording import Readings as Readings
from trackers.core.data.recording import Recording as Recording
from trackers.core.data.recording import stack as stack
from trackers.core.errors import UnusableInput as UnusableInput
from trackers.core.filters.ekf import ExtendedKalman as ExtendedKalman
from trackers.core.filters.filter import AbstractFilter as AbstractFilter
from trackers.core.filters.filter import AbstractSmoothableFilter as AbstractSmoothableFilter
from trackers.core.filters.filter import Innovation as Innovation
from trackers.core.filters.imm import InteractingModels as InteractingModels
from trackers.core.filters.imm import SwitchingMotion as SwitchingMotion
from trackers.core.filters.particle.filter import ParticleFilter as ParticleFilter
from trackers.core.model.algebra import Vector as Vector
from trackers.core.model.algebra import diagonal as diagonal
from trackers.core.model.covariance import Gaussian as Gaussian
from trackers.core.model.inputs import Input as Input
from trackers.core.model.inputs import Need as Need
from trackers.core.model.motion import AbstractMotion as AbstractMotion
from trackers.core.model.motion import Accelerated as Accelerated
from trackers.core.model.motion import ConstantPosition as ConstantPosition
from trackers.core.model.motion import ConstantVelocity as ConstantVelocity
from trackers.core.model.motion import GroundMotion as GroundMotion
from trackers.core.model.motion import Kinematic as Kinematic
from trackers.core.model.motion import Placed as Placed
from trackers.core.model.motion import draw_log_density as draw_log_density
from trackers.core.model.polyline import Polyline as Polyline
from trackers.core.model.rig import Rig as Rig
from trackers.core.model.rig import Station as Station
from trackers.core.model.rig import Tag as Tag
from trackers.core.model.sensor import AbstractSensor as AbstractSensor
from trackers.core.model.sensor import Channel as Channel
from trackers.core.model.sensor import Reading as Reading
from trackers.core.model.sensor import Residual as Residual
from trackers.core.model.sensor import Row as Row
from trackers.core.model.sensor import independent as independent
from trackers.core.model.start import AbstractStart as AbstractStart
from trackers.core.model.state import Heading as Heading
from trackers.core.model.state import Rotation as Rotation
from trackers.core.model.state import wrap as wrap
from trackers.core.model.tunable import Covariance as Covariance
from trackers.core.model.tunable import Fraction as Fraction
from trackers.core.model.tunable import Real as Real
from trackers.core.model.tunable import Scale as Scale
from trackers.core.model.tunable import tunables as tunables
from trackers.core.run.checks import BrokenContract as BrokenContract
from trackers.core.run.checks import check_motion as check_motion
from trackers.core.run.checks import check_sensor as check_sensor
from trackers.core.run.crlb import posterior_bound as posterior_bound
from trackers.core.run.initial import TrackerState as TrackerState
from trackers.core.run.smoother import Smoothed as Smoothed
from trackers.core.run.track_loss import TrackLossPolicy as TrackLossPolicy
from trackers.core.run.track_loss import TrackScorePolicy as TrackScorePolicy
from trackers.core.run.tracker import AbstractTracker as AbstractTracker
from trackers.core.run.tracker import Tracker as Tracker
from trackers.core.run.tracker import filter_batch as filter_batch
from trackers.evaluation.evaluate import Evaluation as Evaluation
from trackers.evaluation.evaluate import evaluate as evaluate
from trackers.evaluation.events import events_of as events_of
from trackers.exchange.compare import TrajectoryErrors as TrajectoryErrors
from trackers.exchange.compare import compare_trajectories as compare_trajectories
from trackers.exchange.imported import import_frames as import_frames
from trackers.exchange.poses import PoseTrajectory as PoseTrajectory
from trackers.exchange.trajectory_files import read_trajectory as read_trajectory
from trackers.exchange.trajectory_files import write_trajectory as write_trajectory
from trackers.from_arrays import bearing_recording as bearing_recording
from trackers.from_arrays import fix_recording as fix_recording
from trackers.from_arrays import phase_recording as phase_recording
from trackers.from_arrays import range_recording as range_recording
from trackers.line.grid import GridFilter as GridFilter
from trackers.line.motion import HaltingMotion as HaltingMotion
from trackers.line.motion import LineMotion as LineMotion
from trackers.line.rows import fit_path_truth as fit_path_truth
from trackers.line.tracker import line_grid_tracker as line_grid_tracker
from trackers.line.tracker import line_motion as line_motion
from trackers.line.tracker import line_tracker as line_tracker
from trackers.line.truth import knot_times as knot_times
from trackers.mhk.tracker import mhk_tracker as mhk_tracker
from trackers.parts.fix_rows import fix_trajectories as fix_trajectories
from trackers.parts.fixes import CorrelatedFixSensor as CorrelatedFixSensor
from trackers.parts.fixes import FixSensor as FixSensor
from trackers.parts.range_rows import range_trajectories as range_trajectories
from trackers.parts.ranges import RangeSensor as RangeSensor
from trackers.parts.singer import Singer as Singer
from trackers.parts.start_nearby import NearbyStart as NearbyStart
from trackers.programs.program_cache import cache_programs as cache_programs
from trackers.recordings.calibration import AnchorCalibration as AnchorCalibration
from trackers.recordings.calibration import Calibration as Calibration
from trackers.recordings.calibration import StationCalibration as StationCalibration
from trackers.recordings.calibration import TagCalibration as TagCalibration
from trackers.recordings.calibration_file import read_calibration as read_calibration
from trackers.recordings.calibration_file import write_calibration as write_calibration
from trackers.recordings.checks import CheckResult as CheckResult
from trackers.recordings.checks import check as check
from trackers.recordings.folder import RecordingFolder as RecordingFolder
from trackers.recordings.folder import read_recording as read
from trackers.recordings.folder import read_recordings as read_all
from trackers.recordings.folder import write_recording as write
from trackers.recordings.kinds import Column as Column
from trackers.recordings.kinds import Kind as Kind
from trackers.recordings.kinds import Sensors as Sensors
from trackers.recordings.kinds import add_kind as add_kind
from trackers.recordings.named_tracker import NamedTracker as NamedTracker
from trackers.recordings.tracker_spec import TrackerSpec as TrackerSpec
from trackers.recordings.tracks import Tracks as Tracks
from trackers.recordings.trajectories import Trajectory as Trajectory
from trackers.recordings.trajectories import kind_trajectories as kind_trajectories
from trackers.uwb_imu.fusion import range_tracker as range_tracker
from trackers.uwb_imu.inertial import inertial_tracker as inertial_tracker
from trackers.uwb_imu.multilateration import multilateration_tracker as multilateration_tracker
from trackers.uwb_imu.ranging import double_sided as double_sided
from trackers.uwb_imu.ranging import single_sided as single_sided
from trackers.uwb_imu.strapdown import PlanarStrapdown as PlanarStrapdown
from trackers.uwb_imu.strapdown import Strapdown as Strapdown
from trackers.uwb_imu.trilateration import trilateration_tracker as trilateration_tracker

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
    # rows of the tables, for a tracker of one's own by file, and a kind of measurement of one's own
    "TrackerSpec",
    "Trajectory",
    "fix_trajectories",
    "range_trajectories",
    "bearing_trajectories",
    "phase_trajectories",
    "beam_trajectories",
    "kind_trajectories",
    "Kind",
    "Column",
    "Sensors",
    "add_kind",
]
