"""How many trajectories one turn of a loop takes."""

from __future__ import annotations

import jax

from trackwright.trackers.core.model.covariance import MOST, side_by_side


def test_few_on_processors_and_thousands_elsewhere(monkeypatch):
    with jax.default_device(jax.devices("cpu")[0]):
        assert [side_by_side(16, size) for size in (3, 16, 10 * MOST)] == [3, 16, 16]
    with jax.default_device("cpu"):
        assert side_by_side(16, 10 * MOST) == 16
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert [side_by_side(16, size) for size in (3, 512, 10 * MOST)] == [3, 512, MOST]
    with jax.default_device(jax.devices("cpu")[0]):
        assert side_by_side(16, 10 * MOST) == 16
