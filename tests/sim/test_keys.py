"""Random numbers depend on (seed, trajectory id, stream) alone."""

import jax
import numpy as np
import pytest

from trackwright.sim.keys import normals, stream, trajectory_keys, uniforms


def test_seed_id_and_stream_each_give_other_numbers():
    zero = trajectory_keys(0, [0])
    keys = zero, trajectory_keys(1, [0]), trajectory_keys(0, [1]), stream(zero, "white"), stream(zero, "drift")
    draws = [normals(one, (15,))[0] for one in (*keys, trajectory_keys(2**32, [0]))]
    assert len({tuple(draw) for draw in draws}) == 6


@pytest.mark.parametrize(("draw", "of_jax"), [(normals, jax.random.normal), (uniforms, jax.random.uniform)])
def test_draws_are_those_of_jax(draw, of_jax):
    keys = stream(trajectory_keys(3, [0, 2**32 - 1, 5]), "name")
    expected = [of_jax(key, (9999,), np.float32) for key in keys]
    np.testing.assert_array_equal(draw(keys, (9999,)), expected)


@pytest.mark.parametrize("double", [False, True])
def test_draws_are_the_same_float32_numbers_whatever_precision_jax_runs_in(double):
    with jax.enable_x64(double):
        draws = normals(stream(trajectory_keys(3, [5]), "name"), (15,))
    assert draws.dtype == np.float32
    assert np.array_equal(draws, normals(stream(trajectory_keys(3, [5]), "name"), (15,)))
