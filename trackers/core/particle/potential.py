"""What a move is worth by itself: factors of the particles' weights, as walls that no tag crosses."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import equinox as eqx

from trackers.core.algebra import Scalar


class AbstractPotential(eqx.Module):
    """What a move says by itself, without any reading: a factor of the weight of the particle that made it."""

    @abstractmethod
    def log_weight(self, before: Any, after: Any) -> Scalar:
        """The factor's logarithm, from what the motion shows of the states before and after: 0 for a usual move.

        NOTHING (`trackers/core/particle/resampling.py`) for one that is impossible.
        """
