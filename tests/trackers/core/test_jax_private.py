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
from trackwright.trackers.programs.program_cache import cache_programs

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


@pytest.fixture
def lacking(monkeypatch):
    """The process with imports of the private parts failing."""
    for name in PRIVATE:
        monkeypatch.setitem(sys.modules, name, None)


def _cubed(x):
    return x * x * x


def test_an_identity_has_the_derivative_one_whatever_it_is_compiled_as():
    same = jax_private.identity("cubed", _cubed)
    assert float(jax.jit(same)(2.0)) == 8.0
    assert float(jax.jit(jax.grad(same))(2.0)) == 1.0  # itself compiled as the cube of the cotangent, one
    elsewhere = jax_private.identity("cubed_on_gpus", _cubed, platform="cuda")
    assert float(jax.jit(elsewhere)(2.0)) == 2.0
    np.testing.assert_array_equal(jax.vmap(elsewhere)(jnp.arange(3.0)), np.arange(3.0))


def test_without_primitives_an_identity_returns_its_array(lacking):
    x = jnp.arange(3.0)
    assert jax_private.identity("cubed", _cubed)(x) is x


def test_constants_of_a_program_are_told_from_variables():
    program = jax.make_jaxpr(lambda x: x + 2.0)(1.0).jaxpr
    x, two = program.eqns[0].invars
    assert not jax_private.is_literal(x)
    assert jax_private.is_literal(two)
    assert two.val == 2.0


@pytest.mark.parametrize("kept", ["the live part", "all"])
def test_a_program_computes_its_outputs_with_or_without_the_dead_part(kept, request):
    program = jax.make_jaxpr(lambda x, y: (jnp.sin(y), 2.0 * x)[1:])(3.0, 4.0).jaxpr
    if kept == "all":
        request.getfixturevalue("lacking")
    live, used = jax_private.live_part(program)
    assert (used, len(live.eqns)) == (([True, False], 1) if kept == "the live part" else ([True, True], 2))
    arguments = [x for x, is_used in zip((3.0, 4.0), used, strict=True) if is_used]
    assert float(jax.core.eval_jaxpr(live, (), *arguments)[0]) == 6.0


def test_settings_of_jax_change_what_programs_depend_on():
    before = jax_private.trace_settings()
    with jax.default_matmul_precision("highest"):
        assert jax_private.trace_settings() != before
    assert jax_private.trace_settings() == before


def test_without_jaxs_lookup_no_programs_are_kept(lacking, tmp_path):
    assert jax_private.trace_settings() is None
    assert cache_programs(tmp_path / "cache") is None
    assert not (tmp_path / "cache").exists()


@pytest.mark.slow
def test_track_estimates_the_same_without_any_private_part(tmp_path):
    assert trackwright("simulate", "agv", "--out", tmp_path / "world", "--n", 2, "--rows", 50).code == 0
    tracks = []
    for name, begin in [("with", ["-m", "trackwright.experiments"]), ("without", ["-c", WITHOUT])]:
        line = [sys.executable, *begin, "track", tmp_path / "world", "--out", tmp_path / name, "--no-figures"]
        done = subprocess.run([*map(str, line)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        tracks.append(pl.read_parquet(tmp_path / name / "tracks.parquet"))
    assert tracks[0]["status"].equals(tracks[1]["status"])
    numbers = [table.select(pl.selectors.float()).to_numpy() for table in tracks]
    np.testing.assert_allclose(*numbers, rtol=1e-4, atol=1e-5)  # single precision, in another order
