"""Settings of the whole suite (double precision, no silent promotion, quick compilation), and fixtures that folders share."""

import tests.checked_shapes  # noqa: F401

# isort: split
import gc
import itertools
import os
from importlib.metadata import version
from pathlib import Path

# Before jax computes. The suite compiles more than it computes: code that LLVM does not optimise takes a quarter less,
# and fusions that do not pass through MLIR, which jaxlib 0.11 cannot be told, a fifth less again.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0"
    + " --xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true"
    * version("jaxlib").startswith("0.10."),
)
# Tests, workers and commands in subprocesses share compiled programs: many of them compile the same tracker.
os.environ.setdefault("TRACKWRIGHT_CACHE", str(Path(__file__).parents[1] / ".pytest_cache" / "programs"))

import jax
import polars as pl
import pytest

from tests.faulty import good_tables, write_good
from tests.in_process import trackwright
from trackwright.experiments.lab.demo import REAL
from trackwright.trackers.core.programs import cache_programs

cache_programs()

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Tracing makes millions of objects that live on: collections at Python's own intervals take a tenth of the time.
gc.set_threshold(100_000, 20, 100)


_TESTS = itertools.count(1)
_MAPS = Path("/proc/self/maps")


@pytest.fixture(autouse=True)
def few_memory_maps():
    """Frees the compiled programs of a process that holds hundreds: each takes dozens of Linux's 65,530 memory maps."""
    yield
    if next(_TESTS) % 20 == 0 and _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings; a test that asks for it is skipped where there is none."""
    folder = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", Path(__file__).parents[2] / "shared" / "recordings"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; TRACKWRIGHT_RECORDINGS names their folder")
    return folder


@pytest.fixture(scope="session")
def shipped() -> Path:
    """The folder of the two real recordings that come with the project: labyrinth and trolley."""
    return REAL


@pytest.fixture(scope="session")
def beginnings(tmp_path_factory):
    """What tests of bad input begin from: a recording, and tracks of it that nobody had to compute."""
    folder = tmp_path_factory.mktemp("bad-input")
    write_good(folder / "good")
    truth = good_tables()["truth"]
    tracks = truth.select(recording=pl.lit("good"), tag="tag", t_s="t_s", x_m=pl.col("x_m") + 0.1, y_m="y_m", z_m="z_m")
    (folder / "tracked").mkdir()
    tracks.with_columns(status=pl.lit("ok")).write_parquet(folder / "tracked" / "tracks.parquet")
    (folder / "tracked" / "recordings.txt").write_text(f"{folder / 'good'}\n")
    return folder


@pytest.fixture(scope="session")
def simulated(beginnings):
    """A simulated recording of two tags, for what only fails once a tracker is built."""
    assert trackwright("simulate", "station", "--out", beginnings / "world", "--n", 2, "--rows", 10).code == 0
    return beginnings / "world"
