from tuning.calibrating import calibrate as calibrate
from tuning.diagnostics import innovations_of as innovations_of
from tuning.diagnostics import violated_assumptions as violated_assumptions
from tuning.fitting import FitResult as FitResult
from tuning.fitting import fit as fit
from tuning.guessing import first_guess as first_guess
from tuning.identifiability import identifiability_issues as identifiability_issues
from tuning.intervals import intervals_of as intervals_of
from tuning.marginal_score import marginal_scores as marginal_scores
from tuning.named_objectives import all_metrics as all_metrics
from tuning.named_objectives import parse_objective as parse_objective
from tuning.objectives import AbstractObjective as AbstractObjective
from tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from tuning.objectives import RootMeanSquareError as RootMeanSquareError
from tuning.objectives import StateLogLikelihood as StateLogLikelihood
from tuning.objectives import Weighted as Weighted
from tuning.optimisers import LBFGS as LBFGS
from tuning.optimisers import Adam as Adam
from tuning.pit_uniformity import PITUniformity as PITUniformity
from tuning.priors import Prior as Prior
from tuning.profiles import bootstrap as bootstrap
from tuning.profiles import profile as profile
from tuning.surface import surface_of as surface_of
from tuning.sweeping import sweep as sweep
from tuning.tuned_file import read_tuned as read_tuned
from tuning.tuned_file import write_tuned as write_tuned

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
