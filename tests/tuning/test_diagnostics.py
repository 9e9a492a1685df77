import numpy as np
import pytest

from tuning.diagnostics import Innovations, violated_assumptions

ROWS = 20_000


def _squares(noise):
    """Innovations of two numbers a row, from standardised noise (n, 2)."""
    return Innovations((noise**2).sum(axis=1), np.full(len(noise), 2.0), np.zeros(len(noise), int))


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(3).normal(size=(ROWS, 2))


def _lasting(white):
    """First-order Gauss-Markov noise of unit variance, two rows in a row correlated by 0.8."""
    noise = white.copy()
    for k in range(1, ROWS):
        noise[k] = 0.8 * noise[k - 1] + 0.6 * white[k]
    return noise


def _wild(white):
    """One row in fifty five times as large, the whole of unit variance."""
    noise = np.where(np.random.default_rng(4).uniform(size=(ROWS, 1)) < 0.02, 5.0, 1.0) * white
    return noise / noise.std()


def test_white_normal_noise_of_the_right_size_contradicts_nothing(white):
    assert violated_assumptions(_squares(white)) == []


@pytest.mark.parametrize(
    ("made", "says"),
    [(_lasting, "independent"), (lambda x: 2 * x, "as large as in"), (_wild, "as rare as")],
)
def test_the_assumption_that_fails_is_the_one_that_is_named(white, made, says):
    (found,) = [x for x in violated_assumptions(_squares(made(white))) if says in x]
    others = [x for x in violated_assumptions(_squares(made(white))) if x != found]
    # Noise twice as large has large errors too often, too.
    assert not others or says == "as large as in"


def test_without_rows_nothing_is_said():
    assert violated_assumptions(_squares(np.zeros((0, 2)))) == []
