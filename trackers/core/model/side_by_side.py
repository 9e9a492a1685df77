"""How many trajectories one turn of a loop of a program takes, by the device that the program is traced for."""

from __future__ import annotations

import jax

MOST = 4096
"""Most trajectories of a turn on a GPU: enough to occupy it, few enough for its memory."""


def side_by_side(on_cpu: int, size: int) -> int:
    """Of `size` trajectories `on_cpu`, which suit the processor's cache; on other devices up to `MOST`.

    There a turn takes as long for a few trajectories as for thousands, since its kernels are started one by one.
    """
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    platform = jax.default_backend() if device is None else getattr(device, "platform", device)
    return min(on_cpu if platform == "cpu" else MOST, size)
