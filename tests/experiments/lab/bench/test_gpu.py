"""The benchmark for GPUs: what it does without one, and that all of its parts run."""

from __future__ import annotations

import jax
import pytest

from experiments.lab.bench import gpu


def test_without_a_gpu_it_writes_nothing_and_names_the_extra(tmp_path, capsys):
    if jax.default_backend() == "gpu":
        pytest.skip("this host has a GPU")
    assert gpu.main(out=tmp_path / "bench-gpu.json") == 2
    assert "trackwright[cuda]" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_every_part_runs_on_whatever_devices_there_are(monkeypatch):
    monkeypatch.setattr(gpu, "ROUNDS", 1)
    with jax.enable_x64(False):
        found = gpu.measured(jax.local_devices(), gpu.Size(2, 8, 5, 8, 4, 1024))
    assert found["beam"]["trajectories"] == 16
    assert found["beam"]["gradient_over_reading"] > 0
    assert found["particles"]["rmse_m"] < 1.0
    assert "8 × 200 × 1000" in gpu.report("1", found)
