"""Flags of XLA's CPU compiler, which jax reads from the environment when it first computes."""

from __future__ import annotations

import os

EXTRA_OPTIONS = "--xla_backend_extra_options"

FLAGS = f"{EXTRA_OPTIONS}=xla_cpu_use_multi_output_fusion,xla_cpu_small_while_loop_byte_threshold=3000000"
"""Multi-output fusion computes terms shared within a filter step once, not once per use. A loop whose step moves few
bytes, as that of one trajectory, becomes one kernel, without hundreds of calls in each step. Neither can be given to a
single compilation."""


def set_flags() -> None:
    """Add `FLAGS` to XLA_FLAGS, unless extra options are set there; without effect on a jax that has computed."""
    present = os.environ.get("XLA_FLAGS", "")
    if EXTRA_OPTIONS not in present:
        os.environ["XLA_FLAGS"] = f"{present} {FLAGS}".strip()
