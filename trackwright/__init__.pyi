from trackwright import sim as sim
from trackwright import tuning as tuning
from trackwright.experiments.monte_carlo.program import expected as expected
from trackwright.experiments.pages import plot as plot
from trackwright.sim import worlds as simulate
from trackwright.trackers import aoa as aoa
from trackwright.trackers import evaluation as evaluation
from trackwright.trackers import exchange as exchange
from trackwright.trackers import line as line
from trackwright.trackers import parts as parts
from trackwright.trackers import uwb_imu as uwb_imu
from trackwright.trackers.aoa.beam import DelayAndSum as DelayAndSum
from trackwright.trackers.aoa.beam import beam_tracker as beam_tracker
from trackwright.trackers.aoa.beam import in_plane_beam_tracker as in_plane_beam_tracker
from trackwright.trackers.aoa.cascade import cascade_tracker as cascade_tracker
from trackwright.trackers.aoa.direct import direct_tracker as direct_tracker
from trackwright.trackers.aoa.fusion import bearing_tracker as bearing_tracker
from trackwright.trackers.baselines.fixes import MovingWindow as MovingWindow
from trackwright.trackers.baselines.fixes import fix_tracker as fix_tracker
from trackwright.trackers.baselines.fixes import singer_tracker as singer_tracker
from trackwright.trackers.baselines.switching import mirror_tracker as mirror_tracker
from trackwright.trackers.baselines.switching import switching_tracker as switching_tracker
from trackwright.trackers.c_source import c_source as c_source
from trackwright.trackers.catalogue import TRACKERS as TRACKERS
from trackwright.trackers.catalogue import build as build
from trackwright.trackers.catalogue import tracker_for as tracker_for
from trackwright.trackers.conformance.parts import BrokenContract as BrokenContract
from trackwright.trackers.conformance.parts import Check as Check
from trackwright.trackers.conformance.parts import check_motion as check_motion
from trackwright.trackers.conformance.parts import check_sensor as check_sensor
from trackwright.trackers.conformance.parts import motion_checks as motion_checks
from trackwright.trackers.conformance.parts import sensor_checks as sensor_checks
from trackwright.trackers.conformance.tables import check_importer as check_importer
from trackwright.trackers.conformance.tables import check_kind as check_kind
from trackwright.trackers.conformance.tables import importer_checks as importer_checks
from trackwright.trackers.conformance.tables import kind_checks as kind_checks
from trackwright.trackers.conformance.trackers import check_tracker as check_tracker
from trackwright.trackers.conformance.trackers import tracker_checks as tracker_checks
from trackwright.trackers.core.data.estimates import Estimates as Estimates
from trackwright.trackers.core.data.estimates import Status as Status
from trackwright.trackers.core.data.recording import Batch as Batch
from trackwright.trackers.core.data.recording import Readings as Readings
from trackwright.trackers.core.data.recording import Recording as Recording
from trackwright.trackers.core.data.recording import stack as stack
from trackwright.trackers.core.errors import UnusableInput as UnusableInput
from trackwright.trackers.core.filters.ekf import ExtendedKalman as ExtendedKalman
from trackwright.trackers.core.filters.filter import AbstractFilter as AbstractFilter
from trackwright.trackers.core.filters.particle.filter import ParticleFilter as ParticleFilter
from trackwright.trackers.core.model.algebra import Vector as Vector
from trackwright.trackers.core.model.algebra import diagonal as diagonal
from trackwright.trackers.core.model.covariance import Gaussian as Gaussian
from trackwright.trackers.core.model.covariance import compiler_options as compiler_options
from trackwright.trackers.core.model.inputs import Input as Input
from trackwright.trackers.core.model.inputs import Need as Need
from trackwright.trackers.core.model.motion import AbstractMotion as AbstractMotion
from trackwright.trackers.core.model.motion import ConstantVelocity as ConstantVelocity
from trackwright.trackers.core.model.motion import Kinematic as Kinematic
from trackwright.trackers.core.model.motion import draw_log_density as draw_log_density
from trackwright.trackers.core.model.polyline import Polyline as Polyline
from trackwright.trackers.core.model.rig import Rig as Rig
from trackwright.trackers.core.model.rig import Station as Station
from trackwright.trackers.core.model.rig import Tag as Tag
from trackwright.trackers.core.model.sensor import AbstractSensor as AbstractSensor
from trackwright.trackers.core.model.sensor import Channel as Channel
from trackwright.trackers.core.model.sensor import Reading as Reading
from trackwright.trackers.core.model.sensor import Residual as Residual
from trackwright.trackers.core.model.sensor import Row as Row
from trackwright.trackers.core.model.sensor import independent as independent
from trackwright.trackers.core.model.start import AbstractStart as AbstractStart
from trackwright.trackers.core.model.state import Heading as Heading
from trackwright.trackers.core.model.tunable import Covariance as Covariance
from trackwright.trackers.core.model.tunable import Fraction as Fraction
from trackwright.trackers.core.model.tunable import Real as Real
from trackwright.trackers.core.model.tunable import Scale as Scale
from trackwright.trackers.core.model.tunable import tunables as tunables
from trackwright.trackers.core.run.smoother import Smoothed as Smoothed
from trackwright.trackers.core.run.track_loss import TrackLossPolicy as TrackLossPolicy
from trackwright.trackers.core.run.tracker import AbstractTracker as AbstractTracker
from trackwright.trackers.core.run.tracker import Tracker as Tracker
from trackwright.trackers.core.run.tracker import TrackerState as TrackerState
from trackwright.trackers.core.run.tracker import filter_batch as filter_batch
from trackwright.trackers.evaluation.evaluate import Evaluation as Evaluation
from trackwright.trackers.evaluation.evaluate import evaluate as evaluate
from trackwright.trackers.from_arrays import bearing_recording as bearing_recording
from trackwright.trackers.from_arrays import fix_recording as fix_recording
from trackwright.trackers.from_arrays import phase_recording as phase_recording
from trackwright.trackers.from_arrays import range_recording as range_recording
from trackwright.trackers.line.tracker import line_grid_tracker as line_grid_tracker
from trackwright.trackers.line.tracker import line_tracker as line_tracker
from trackwright.trackers.linear import linear as linear
from trackwright.trackers.linear import nonlinear as nonlinear
from trackwright.trackers.linear import series as series
from trackwright.trackers.mhk.tracker import mhk_tracker as mhk_tracker
from trackwright.trackers.parts.fixes import FixSensor as FixSensor
from trackwright.trackers.parts.fixes import fix_trajectories as fix_trajectories
from trackwright.trackers.parts.ranges import RangeSensor as RangeSensor
from trackwright.trackers.parts.ranges import range_trajectories as range_trajectories
from trackwright.trackers.programs.program_cache import cache_programs as cache_programs
from trackwright.trackers.recordings.calibration import AnchorCalibration as AnchorCalibration
from trackwright.trackers.recordings.calibration import Calibration as Calibration
from trackwright.trackers.recordings.calibration import StationCalibration as StationCalibration
from trackwright.trackers.recordings.calibration import TagCalibration as TagCalibration
from trackwright.trackers.recordings.calibration import read_calibration as read_calibration
from trackwright.trackers.recordings.calibration import write_calibration as write_calibration
from trackwright.trackers.recordings.checks.all_checks import check as check
from trackwright.trackers.recordings.checks.rules import CheckResult as CheckResult
from trackwright.trackers.recordings.folder import RecordingFolder as RecordingFolder
from trackwright.trackers.recordings.folder import read_recording as read
from trackwright.trackers.recordings.folder import read_recordings as read_all
from trackwright.trackers.recordings.folder import write_recording as write
from trackwright.trackers.recordings.kinds import Column as Column
from trackwright.trackers.recordings.kinds import Kind as Kind
from trackwright.trackers.recordings.kinds import Sensors as Sensors
from trackwright.trackers.recordings.kinds import add_kind as add_kind
from trackwright.trackers.recordings.named_tracker import NamedTracker as NamedTracker
from trackwright.trackers.recordings.named_tracker import TrackerSpec as TrackerSpec
from trackwright.trackers.recordings.tracks import Tracks as Tracks
from trackwright.trackers.recordings.trajectories import Trajectory as Trajectory
from trackwright.trackers.recordings.trajectories import kind_trajectories as kind_trajectories
from trackwright.trackers.uwb_imu.fusion import range_tracker as range_tracker
from trackwright.trackers.uwb_imu.inertial import inertial_tracker as inertial_tracker
from trackwright.trackers.uwb_imu.trilateration import multilateration_tracker as multilateration_tracker
from trackwright.trackers.uwb_imu.trilateration import trilateration_tracker as trilateration_tracker
from trackwright.tuning.calibrating import calibrate as calibrate
from trackwright.tuning.fitting import FitOptions as FitOptions
from trackwright.tuning.fitting import FitResult as FitResult
from trackwright.tuning.fitting import fit as fit
from trackwright.tuning.objectives import AbstractObjective as AbstractObjective
from trackwright.tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from trackwright.tuning.objectives import RootMeanSquareError as RootMeanSquareError
from trackwright.tuning.objectives import StateLogLikelihood as StateLogLikelihood
from trackwright.tuning.optimisation import LBFGS as LBFGS
from trackwright.tuning.optimisation import Adam as Adam
from trackwright.tuning.own_levels import fitted as fitted
from trackwright.tuning.survey import Survey as Survey
from trackwright.tuning.survey import survey as survey
from trackwright.tuning.sweeping import sweep as sweep
from trackwright.tuning.tuned_file import read_tuned as read_tuned
from trackwright.tuning.tuned_file import write_tuned as write_tuned

__version__: str

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
    "expected",
    "Evaluation",
    # trackers ready to run on arrays
    "linear",
    "nonlinear",
    "series",
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
    "DelayAndSum",
    "Smoothed",
    "c_source",
    # parts of a tracker: filters, starts, track loss
    "AbstractTracker",
    "Tracker",
    "TrackerState",
    "filter_batch",
    "compiler_options",
    "Row",
    "AbstractFilter",
    "ExtendedKalman",
    "Gaussian",
    "ParticleFilter",
    "TrackLossPolicy",
    "AbstractStart",
    # states and motions
    "Vector",
    "Heading",
    "diagonal",
    "Kinematic",
    "AbstractMotion",
    "draw_log_density",
    "ConstantVelocity",
    "Polyline",
    # sensors
    "AbstractSensor",
    "Channel",
    "Input",
    "Need",
    "Reading",
    "Residual",
    "independent",
    "FixSensor",
    "RangeSensor",
    # numbers that can be tuned
    "Scale",
    "Fraction",
    "Real",
    "Covariance",
    "tunables",
    # a tracker by file: rows of the tables, and a kind of measurement of one's own
    "TrackerSpec",
    "Trajectory",
    "fix_trajectories",
    "range_trajectories",
    "kind_trajectories",
    "Kind",
    "Column",
    "Sensors",
    "add_kind",
    # whether one's own parts keep their contracts: asserted, and as checks for pytest
    "check_motion",
    "check_sensor",
    "check_tracker",
    "check_kind",
    "check_importer",
    "motion_checks",
    "sensor_checks",
    "tracker_checks",
    "kind_checks",
    "importer_checks",
    "Check",
    "BrokenContract",
    # fits
    "fit",
    "fitted",
    "FitOptions",
    "FitResult",
    "LBFGS",
    "Adam",
    "sweep",
    # objectives
    "AbstractObjective",
    "NegativeLogLikelihood",
    "RootMeanSquareError",
    "StateLogLikelihood",
    # systematic errors of stations and anchors, positions of anchors without truth, tuned files
    "calibrate",
    "survey",
    "Survey",
    "read_tuned",
    "write_tuned",
    # modules
    "simulate",
    "plot",
    "sim",
    "tuning",
    "aoa",
    "evaluation",
    "exchange",
    "line",
    "parts",
    "uwb_imu",
]
