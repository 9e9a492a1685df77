from trackwright.tuning.calibrating import calibrate as calibrate
from trackwright.tuning.diagnostics import innovations_of as innovations_of
from trackwright.tuning.diagnostics import violated_assumptions as violated_assumptions
from trackwright.tuning.fitting import FitResult as FitResult
from trackwright.tuning.fitting import fit as fit
from trackwright.tuning.guessing import first_guess as first_guess
from trackwright.tuning.identifiability import identifiability_issues as identifiability_issues
from trackwright.tuning.intervals import intervals_of as intervals_of
from trackwright.tuning.marginal_score import marginal_scores as marginal_scores
from trackwright.tuning.named_objectives import all_metrics as all_metrics
from trackwright.tuning.named_objectives import parse_objective as parse_objective
from trackwright.tuning.objectives import AbstractObjective as AbstractObjective
from trackwright.tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from trackwright.tuning.objectives import RootMeanSquareError as RootMeanSquareError
from trackwright.tuning.objectives import StateLogLikelihood as StateLogLikelihood
from trackwright.tuning.objectives import Weighted as Weighted
from trackwright.tuning.optimisers import LBFGS as LBFGS
from trackwright.tuning.optimisers import Adam as Adam
from trackwright.tuning.pit_uniformity import PITUniformity as PITUniformity
from trackwright.tuning.priors import Prior as Prior
from trackwright.tuning.profiles import bootstrap as bootstrap
from trackwright.tuning.profiles import profile as profile
from trackwright.tuning.surface import surface_of as surface_of
from trackwright.tuning.sweeping import sweep as sweep
from trackwright.tuning.tuned_file import read_tuned as read_tuned
from trackwright.tuning.tuned_file import write_tuned as write_tuned

__all__ = [
    "LBFGS",
    "AbstractObjective",
    "Adam",
    "FitResult",
    "NegativeLogLikelihood",
    "PITUniformity",
    "Prior",
    "RootMeanSquareError",
    "StateLogLikelihood",
    "Weighted",
    "all_metrics",
    "bootstrap",
    "calibrate",
    "first_guess",
    "fit",
    "identifiability_issues",
    "innovations_of",
    "intervals_of",
    "marginal_scores",
    "parse_objective",
    "profile",
    "read_tuned",
    "surface_of",
    "sweep",
    "violated_assumptions",
    "write_tuned",
]
