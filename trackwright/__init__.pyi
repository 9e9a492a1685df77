from trackwright import sim as sim
from trackwright import tuning as tuning
from trackwright.experiments.monte_carlo.program import expected as expected
from trackwright.experiments.pages import plot as plot
from trackwright.sim import worlds as simulate
from trackwright.trackers import aoa as aoa
from trackwright.trackers import baselines as baselines
from trackwright.trackers import evaluation as evaluation
from trackwright.trackers import exchange as exchange
from trackwright.trackers import line as line
from trackwright.trackers import mhk as mhk
from trackwright.trackers import parts as parts
from trackwright.trackers import uwb_imu as uwb_imu
from trackwright.trackers.c_source import c_source as c_source
from trackwright.trackers.catalogue import TRACKERS as TRACKERS
from trackwright.trackers.catalogue import build as build
from trackwright.trackers.catalogue import tracker_for as tracker_for
from trackwright.trackers.conformance.parts import BrokenContract as BrokenContract
from trackwright.trackers.conformance.parts import check_motion as check_motion
from trackwright.trackers.conformance.parts import check_sensor as check_sensor
from trackwright.trackers.conformance.tables import check_importer as check_importer
from trackwright.trackers.conformance.tables import check_kind as check_kind
from trackwright.trackers.conformance.trackers import check_tracker as check_tracker
from trackwright.trackers.core.data.estimates import Estimates as Estimates
from trackwright.trackers.core.data.estimates import Status as Status
from trackwright.trackers.core.data.recording import Batch as Batch
from trackwright.trackers.core.data.recording import Readings as Readings
from trackwright.trackers.core.data.recording import Recording as Recording
from trackwright.trackers.core.data.recording import stack as stack
from trackwright.trackers.core.errors import UnusableInput as UnusableInput
from trackwright.trackers.core.filters.filter import AbstractFilter as AbstractFilter
from trackwright.trackers.core.filters.filter import AbstractStart as AbstractStart
from trackwright.trackers.core.model.algebra import Vector as Vector
from trackwright.trackers.core.model.algebra import diagonal as diagonal
from trackwright.trackers.core.model.covariance import Gaussian as Gaussian
from trackwright.trackers.core.model.covariance import compiler_options as compiler_options
from trackwright.trackers.core.model.inputs import Input as Input
from trackwright.trackers.core.model.inputs import Need as Need
from trackwright.trackers.core.model.motion import AbstractMotion as AbstractMotion
from trackwright.trackers.core.model.motion import draw_log_density as draw_log_density
from trackwright.trackers.core.model.rig import Rig as Rig
from trackwright.trackers.core.model.rig import Station as Station
from trackwright.trackers.core.model.rig import Tag as Tag
from trackwright.trackers.core.model.sensor import AbstractSensor as AbstractSensor
from trackwright.trackers.core.model.sensor import Channel as Channel
from trackwright.trackers.core.model.sensor import Reading as Reading
from trackwright.trackers.core.model.sensor import Residual as Residual
from trackwright.trackers.core.model.sensor import Row as Row
from trackwright.trackers.core.model.sensor import independent as independent
from trackwright.trackers.core.model.state import Heading as Heading
from trackwright.trackers.core.model.tunable import Covariance as Covariance
from trackwright.trackers.core.model.tunable import Fraction as Fraction
from trackwright.trackers.core.model.tunable import Real as Real
from trackwright.trackers.core.model.tunable import Scale as Scale
from trackwright.trackers.core.model.tunable import tunables as tunables
from trackwright.trackers.core.programs import cache_programs as cache_programs
from trackwright.trackers.core.run.smoother import Smoothed as Smoothed
from trackwright.trackers.core.run.tracker import AbstractTracker as AbstractTracker
from trackwright.trackers.core.run.tracker import Tracker as Tracker
from trackwright.trackers.core.run.tracker import TrackerState as TrackerState
from trackwright.trackers.core.run.tracker import filter_batch as filter_batch
from trackwright.trackers.evaluation.evaluate import Evaluation as Evaluation
from trackwright.trackers.evaluation.evaluate import evaluate as evaluate
from trackwright.trackers.linear import linear as linear
from trackwright.trackers.linear import nonlinear as nonlinear
from trackwright.trackers.linear import series as series
from trackwright.trackers.recordings.calibration import Calibration as Calibration
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
from trackwright.trackers.recordings.tracks import Trajectory as Trajectory
from trackwright.trackers.recordings.tracks import kind_trajectories as kind_trajectories
from trackwright.tuning.calibrating import calibrate as calibrate
from trackwright.tuning.fitting import FitOptions as FitOptions
from trackwright.tuning.fitting import FitResult as FitResult
from trackwright.tuning.fitting import fit as fit
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
    "Batch",
    "stack",
    "Calibration",
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
    # filters given as matrices or functions, smoothing, and a tracker as C
    "linear",
    "nonlinear",
    "series",
    "Smoothed",
    "c_source",
    # what a tracker is made of
    "AbstractTracker",
    "Tracker",
    "TrackerState",
    "filter_batch",
    "compiler_options",
    "Row",
    "AbstractFilter",
    "Gaussian",
    "AbstractStart",
    # states and motions
    "Vector",
    "Heading",
    "diagonal",
    "AbstractMotion",
    "draw_log_density",
    # sensors
    "AbstractSensor",
    "Channel",
    "Input",
    "Need",
    "Reading",
    "Residual",
    "independent",
    # numbers that can be tuned
    "Scale",
    "Fraction",
    "Real",
    "Covariance",
    "tunables",
    # a tracker by file: rows of the tables, and a kind of measurement of one's own
    "TrackerSpec",
    "Trajectory",
    "kind_trajectories",
    "Kind",
    "Column",
    "Sensors",
    "add_kind",
    # whether one's own parts keep their contracts
    "check_motion",
    "check_sensor",
    "check_tracker",
    "check_kind",
    "check_importer",
    "BrokenContract",
    # fits
    "fit",
    "fitted",
    "FitOptions",
    "FitResult",
    "sweep",
    # systematic errors of stations and anchors, anchors without truth, tuned files
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
    "baselines",
    "evaluation",
    "exchange",
    "line",
    "mhk",
    "parts",
    "uwb_imu",
]
