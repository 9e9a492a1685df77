from trackwright.trackers.recordings.calibration import AnchorCalibration as AnchorCalibration
from trackwright.trackers.recordings.calibration import StationCalibration as StationCalibration
from trackwright.trackers.recordings.calibration import TagCalibration as TagCalibration
from trackwright.tuning.fitting import Progress as Progress
from trackwright.tuning.objectives import AbstractObjective as AbstractObjective
from trackwright.tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from trackwright.tuning.objectives import RootMeanSquareError as RootMeanSquareError
from trackwright.tuning.objectives import StateLogLikelihood as StateLogLikelihood
from trackwright.tuning.objectives import parse_objective as parse_objective
from trackwright.tuning.optimisation import LBFGS as LBFGS
from trackwright.tuning.optimisation import Adam as Adam

__all__ = [
    "LBFGS",
    "AbstractObjective",
    "Adam",
    "AnchorCalibration",
    "NegativeLogLikelihood",
    "Progress",
    "RootMeanSquareError",
    "StateLogLikelihood",
    "StationCalibration",
    "TagCalibration",
    "parse_objective",
]
