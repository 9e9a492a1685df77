"""Fit noise levels and other numbers of trackers to recordings by gradient."""

from tuning.consistency import Consistency as Consistency
from tuning.figures import every_figure as every_figure
from tuning.figures import parse_objective as parse_objective
from tuning.first_guess import first_guess as first_guess
from tuning.fit import FitResult as FitResult
from tuning.fit import fit as fit
from tuning.judgement import judgements as judgements
from tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from tuning.objectives import RootMeanSquareError as RootMeanSquareError
from tuning.objectives import StateLogLikelihood as StateLogLikelihood
from tuning.objectives import Weighted as Weighted
from tuning.priors import Prior as Prior
from tuning.profiles import bootstrap as bootstrap
from tuning.profiles import profile as profile

__all__ = [
    "Consistency",
    "FitResult",
    "NegativeLogLikelihood",
    "Prior",
    "RootMeanSquareError",
    "StateLogLikelihood",
    "Weighted",
    "bootstrap",
    "every_figure",
    "first_guess",
    "fit",
    "judgements",
    "parse_objective",
    "profile",
]
