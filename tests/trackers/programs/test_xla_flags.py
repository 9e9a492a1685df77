"""Importing the package sets XLA's flags, but not over the user's."""

import os
import subprocess
import sys

import pytest

from trackwright.trackers.programs.xla_flags import FLAGS

USERS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=2048"


@pytest.mark.parametrize(
    ("before", "after"),
    [(None, FLAGS), ("--xla_dump_to=x", f"--xla_dump_to=x {FLAGS}"), (USERS, USERS)],
    ids=["none", "another", "the same option"],
)
def test_the_import_adds_flags_unless_the_user_set_the_same_option(before, after):
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"} | (
        {} if before is None else {"XLA_FLAGS": before}
    )
    program = "import os, sys, trackwright; print(os.environ['XLA_FLAGS'], 'jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == f"{after} False"
