"""Potentials: log-weights of moves, without any measurement, as walls that no tag crosses."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import equinox as eqx

from trackers.core.algebra import Scalar


class AbstractPotential(eqx.Module):
    """A factor of a particle's weight that depends on its last move alone."""

    @abstractmethod
    def log_weight(self, before: Any, after: Any) -> Scalar:
        """The log of the factor, from `motion.view` of the states before and after the move.

        0 for an ordinary move, `LOG_ZERO` (`trackers/core/particle/resampling.py`) for an impossible one.
        """
