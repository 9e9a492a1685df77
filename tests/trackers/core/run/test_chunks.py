"""Numbers do not know how many devices or threads share the work; threads share what is compiled."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording, stack
from trackwright.trackers.core.run.chunks import CHUNK, chunks, piece_size, run_chunks

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


def test_no_number_of_trajectories_is_padded_to_more_than_a_larger_one_or_by_a_quarter():
    numbers = np.arange(17, 2001)
    sizes = np.array([piece_size(int(n), 200, CHUNK) for n in numbers])
    padded = sizes * -(-numbers // sizes)
    assert (sizes <= CHUNK).all()
    assert (np.diff(padded) >= 0).all()
    assert (padded[numbers > 32] <= 1.25 * numbers[numbers > 32]).all()


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


def _summed(model, part):
    return part.readings["fixes"].values.sum(axis=0) * (1.0 + model)
