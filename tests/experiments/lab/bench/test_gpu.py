"""The benchmark for GPUs: what it does without one, and that all of its parts run."""

from __future__ import annotations

import jax
import pytest

from trackwright.experiments.lab.bench import gpu
from trackwright.experiments.lab.cases import Output
from trackwright.trackers.core.errors import UnusableInput


def test_without_a_gpu_it_writes_nothing_and_names_the_extra(tmp_path):
    if jax.default_backend() == "gpu":
        pytest.skip("this host has a GPU")
    with pytest.raises(UnusableInput, match=r"trackwright\[cuda\]"):
        gpu.gpu(output=Output(out=tmp_path / "bench-gpu.json"))
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_every_part_runs_on_whatever_devices_there_are():
    with jax.enable_x64(False):
        likelihood, gradient, particles = gpu.on(jax.local_devices(), gpu.SMALL, 1)
    assert likelihood["trajectories"] == 16
    assert gradient["times reading once"] > 0
    assert particles["error"] < 1.0
    assert particles["what"] == "filter of 1,000 particles"
