"""Where a release of jax lacks a private part, everything computes the same without it."""

from __future__ import annotations

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from tests.in_process import trackwright
from trackwright.trackers.core import jax_private

PRIVATE = (
    "jax.extend.core",
    "jax.interpreters.partial_eval",
    "jax._src.config",
    "jax._src.compilation_cache",
    "jax._src.compiler",
)
WITHOUT = f"""import sys, jax.experimental.serialize_executable, equinox, optax
for name in {PRIVATE}:
    sys.modules[name] = None
from trackwright.trackers.core import jax_private
assert jax_private.cache_opener() is None
from trackwright.experiments.cli.main import main
sys.exit(main())
"""


def _cubed(x):
    return x * x * x


def test_an_identity_has_the_derivative_one_whatever_it_is_compiled_as():
    same = jax_private.identity("cubed", _cubed)
    assert float(jax.jit(same)(2.0)) == 8.0
    assert float(jax.jit(jax.grad(same))(2.0)) == 1.0  # itself compiled as the cube of the cotangent, one
    elsewhere = jax_private.identity("cubed_on_gpus", _cubed, platform="cuda")
    assert float(jax.jit(elsewhere)(2.0)) == 2.0
    np.testing.assert_array_equal(jax.vmap(elsewhere)(jnp.arange(3.0)), np.arange(3.0))


def test_settings_of_jax_change_what_programs_depend_on():
    before = jax_private.trace_settings()
    with jax.default_matmul_precision("highest"):
        assert jax_private.trace_settings() != before
    assert jax_private.trace_settings() == before


@pytest.mark.slow
def test_track_estimates_the_same_without_any_private_part(tmp_path):
    assert trackwright("simulate", "agv", "--out", tmp_path / "world", "--n", 2, "--rows", 50).code == 0
    tracks = []
    for name, begin in [("with", ["-m", "trackwright"]), ("without", ["-c", WITHOUT])]:
        line = [sys.executable, *begin, "track", tmp_path / "world", "--out", tmp_path / name]
        done = subprocess.run([*map(str, line)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        tracks.append(pl.read_parquet(tmp_path / name / "tracks.parquet"))
    assert tracks[0]["status"].equals(tracks[1]["status"])
    numbers = [table.select(pl.selectors.float()).to_numpy() for table in tracks]
    np.testing.assert_allclose(*numbers, rtol=1e-4, atol=1e-5)  # single precision, in another order
