"""Fit noise levels and other numbers of trackers to recordings by gradient."""

from tuning.fit import FitResult as FitResult
from tuning.fit import fit as fit
from tuning.objectives import NegativeLogLikelihood as NegativeLogLikelihood
from tuning.objectives import RootMeanSquareError as RootMeanSquareError

__all__ = ["FitResult", "NegativeLogLikelihood", "RootMeanSquareError", "fit"]
