"""The oracle of a hidden Markov chain: every sequence of its states, one after the other; NumPy alone."""

from __future__ import annotations

import math
from itertools import pairwise, product

import numpy as np

SHARES = np.array([0.45, 0.35, 0.2])
"""How often each state is drawn."""

LEVELS = np.array([-1.0, 0.2, 1.5])
"""What is seen in each state, but for noise."""

INTERVALS = np.array([0.3, 0.6, 0.2, 0.9, 0.4, 0.5])
"""Seconds before each row but the first."""

RATE, SIGMA = 0.8, 0.7
"""Draws per second, and the noise of what is seen."""

STEP = 1e-5
"""Of the central differences by the logarithm."""


def readings() -> np.ndarray:
    """What is seen (T,)."""
    return np.random.default_rng(2).normal(0.3, 1.0, len(INTERVALS) + 1)


def log_likelihood(rate: float, sigma: float) -> float:
    """log L of the readings, the sum over all sequences of states."""
    seen = readings()
    density = np.exp(-0.5 * ((seen[:, None] - LEVELS) / sigma) ** 2) / sigma
    kept = np.exp(-rate * INTERVALS)
    whole = 0.0
    for path in product(range(len(SHARES)), repeat=len(seen)):
        p = SHARES[path[0]]
        for row, (i, j) in enumerate(pairwise(path)):
            p *= kept[row] * (i == j) + (1 - kept[row]) * SHARES[j]
        whole += p * math.prod(density[row, state] for row, state in enumerate(path))
    return math.log(whole)


def slopes() -> tuple[float, float]:
    """d log L by the logarithms of the rate and of the noise."""
    step = math.exp(STEP)
    rates = log_likelihood(RATE * step, SIGMA) - log_likelihood(RATE / step, SIGMA)
    sigmas = log_likelihood(RATE, SIGMA * step) - log_likelihood(RATE, SIGMA / step)
    return rates / (2 * STEP), sigmas / (2 * STEP)
