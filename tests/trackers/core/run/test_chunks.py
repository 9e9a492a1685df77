"""Numbers do not know how many devices or threads share the work; threads share what is compiled."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.run.chunks import LONG, as_numbers, chunks, n_workers, piece_size, pieces, run_chunks

HASHED = """
import hashlib, jax, numpy as np
from tests.trackers.core.run.test_chunks import _many
from trackwright.trackers.baselines.fixes import fix_tracker
found = fix_tracker().run(_many(1100))
print(jax.device_count(), hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in
      [*found.mean.position, found.cov_upper, found.log_likelihood])).hexdigest())
"""


def _many(trajectories, rows=30):
    """Fixes of so many tags that walk at random."""
    rng, times = np.random.default_rng(5), 0.1 * np.arange(rows)
    walks = np.cumsum(0.1 * rng.normal(size=(trajectories, rows, 3)), axis=1) + 0.2 * rng.normal(
        size=(trajectories, rows, 3)
    )
    seen, height = np.ones((rows, 3), bool), {"height": np.zeros(rows)}
    every = [Recording(times, {"fixes": Readings(w, seen)}, height, name=str(k)) for k, w in enumerate(walks)]
    return stack(every)


@pytest.mark.slow
def test_one_device_and_two_give_the_same_bits():
    printed = []
    for devices in (1, 2):
        flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(
            [sys.executable, "-c", HASHED], env=os.environ | flags, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        printed.append(done.stdout.split())
    assert [int(count) for count, _ in printed] == [1, 2]
    assert printed[0][1] == printed[1][1]


def test_floats_alone_become_numbers_of_the_type():
    whole = [3, True, np.int64(4), np.arange(2), np.array([True]), jnp.arange(2), "name"]
    numbers = as_numbers([*whole, 0.5, np.float64(0.25), np.ones(2), jnp.ones(2), None], np.float32)
    assert all(x is y for x, y in zip(numbers, whole, strict=False))
    assert [x.dtype for x in numbers[len(whole) : -1]] == [np.float32] * 4
    assert [type(x) for x in numbers[len(whole) : -2]] == [np.ndarray] * 3
    assert isinstance(numbers[-2], jax.Array)


@pytest.mark.parametrize(("large_state", "most"), [(False, 16), (True, 64)])
def test_some_dozens_run_in_pieces_of_few_of_one_size_with_little_padding(large_state, most):
    for count in range(9, most + 1):
        size = piece_size(count, 50, 512, large_state)
        assert 5 <= size <= 8
        assert -count % size < -(-count // size)
        assert piece_size(count, LONG, 512, large_state) == 1
    assert piece_size(most + 1, 50, 512, large_state) == piece_size(most + 1, LONG, 512, large_state) == 2 * most
    assert piece_size(most, 50, 4, large_state) == 4  # a smaller chunk binds


def test_pieces_are_the_batch_in_order():
    batch = _many(11, 6)
    parts = pieces(batch, 512)
    assert [part.size for part in parts] == [6, 6]
    joined = np.concatenate([part.dt for part in parts], axis=1)
    np.testing.assert_array_equal(joined[:, :11], batch.dt)
    assert not parts[-1].valid[:, -1].any()


def test_parts_side_by_side_are_those_one_after_another_in_their_order():
    parts = list(chunks(_many(5 * 8, 6), 8))
    together = run_chunks(_summed, [(k, part) for k, part in enumerate(parts)])
    alone = [run_chunks(_summed, [(k, part)])[0] for k, part in enumerate(parts)]
    np.testing.assert_array_equal(together, alone)
    assert len({float(x.sum()) for x in together}) == len(parts)


def test_threads_work_in_the_callers_precision_and_compile_once():
    compiled = []

    def function(model, part):
        compiled.append(part.dt.dtype)
        return part.dt * model

    def model(k):
        return np.asarray(k, np.float32)

    with jax.enable_x64(False):
        parts = list(chunks(_many(4 * 16, 6), 16))
        results = run_chunks(function, [(model(k), part) for k, part in enumerate(parts)])
    assert {x.dtype for x in results} == {np.dtype(np.float32)}
    assert compiled == [np.dtype(np.float32)]


def test_an_error_in_one_part_is_the_callers():
    def function(model, part):
        raise ZeroDivisionError("in a thread")

    parts = list(chunks(_many(32, 6), 16))
    before = threading.active_count()
    with pytest.raises(ZeroDivisionError, match="in a thread"):
        run_chunks(function, [(None, part) for part in parts])
    assert threading.active_count() == before


def test_a_cpu_has_a_thread_for_every_core():
    assert n_workers() == max(jax.local_device_count(), len(os.sched_getaffinity(0)))


def _summed(model, part):
    return part.readings["fixes"].values.sum(axis=0) * (1.0 + model)
