"""The shapes in annotations are checked while tests run: an array of another shape or type is an error in each package."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from trackwright.sim.corruptions import gauss_markov
from trackwright.sim.keys import trajectory_keys
from trackwright.trackers.core.data.consistency import nees
from trackwright.tuning.optimisation import LBFGS


def test_core():
    covs = np.stack([np.eye(2)] * 3)
    assert nees(np.zeros((3, 2)), covs).shape == (3,)
    with pytest.raises(TypeCheckError, match="covs"):
        nees(np.zeros((3, 2)), covs[0])


def test_tuning():
    optimiser, vectors = LBFGS(), np.zeros((2, 3))
    state = optimiser.init(vectors)
    with pytest.raises(TypeCheckError, match="gradients"):
        optimiser.propose(state, vectors, np.zeros((2, 4)))


def test_sim():
    corrupt, keys = gauss_markov(0.1, 1.0), trajectory_keys(0, [0, 1])
    values, seen = np.zeros((2, 5, 3)), np.ones((2, 5, 3), bool)
    corrupt(keys, np.arange(5.0), values, seen)
    for times, mask in ((np.arange(4.0), seen), (np.arange(5.0), np.ones((2, 5, 3)))):
        with pytest.raises(TypeCheckError, match=r"sim\.corruptions"):
            corrupt(keys, times, values, mask)
