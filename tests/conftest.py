"""Settings of the whole suite: double precision, no silent promotion, quick compilation, and where real recordings are."""

import os
from pathlib import Path

from experiments.cli.runtime import FUSION

# Before jax is imported: it halves the time that XLA takes to compile, which is what most of the suite waits for.
os.environ.setdefault("XLA_FLAGS", FUSION)

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings; a test that asks for it is skipped where there is none."""
    default = Path(__file__).parents[2] / "shared" / "recordings"
    folder = Path(os.environ.get("TRACKWRIGHT_RECORDINGS", default))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; TRACKWRIGHT_RECORDINGS names their folder")
    return folder
