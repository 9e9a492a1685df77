"""Settings that jax reads when it is imported; whoever wants them calls `set_flags` before. Imports no jax itself."""

from __future__ import annotations

import gc
import os

FUSION = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion"
"""XLA's CPU compiler then keeps shared terms of a filter step instead of computing them once per use."""


COLLECT_AFTER = 200_000
"""New objects after which Python looks for garbage: tracing makes as many that stay, and looks took a sixth of it."""


def set_flags() -> None:
    """Add multi-output fusion to XLA_FLAGS, unless the user already says so there; look for garbage less often."""
    gc.set_threshold(COLLECT_AFTER, *gc.get_threshold()[1:])
    present = os.environ.get("XLA_FLAGS", "")
    if FUSION.split("=")[0] not in present:
        os.environ["XLA_FLAGS"] = f"{present} {FUSION}".strip()
