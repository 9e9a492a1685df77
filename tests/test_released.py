"""The bits that releases keep, and the lines of the changelog for those that a release changed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.released import CHANGES, KEPT, environment, unexplained

ROOT = Path(__file__).parents[1]


def test_a_changed_digest_has_a_line_in_the_changelog():
    assert not unexplained(json.loads(KEPT.read_text("utf-8")), CHANGES.read_text("utf-8"))


def test_a_digest_that_replaced_another_is_missed_in_the_changelog_and_a_first_one_is_not():
    kept = {"digests": {"study, agv": ["a" * 64, "b" * 64], "case, uwb": ["c" * 64]}}
    assert unexplained(kept, "- Ranges are read in double precision (cccccccccccc)") == ["study, agv: bbbbbbbbbbbb"]
    assert not unexplained(kept, "- Vehicles turn (study, agv: bbbbbbbbbbbb)")


@pytest.mark.slow
def test_the_stated_numbers_have_the_bits_of_the_release():
    kept = json.loads(KEPT.read_text("utf-8"))["environment"]
    if kept != environment():
        pytest.skip(f"bits are kept for {kept}; `make digests` compares commits on one machine")
    # With fusions compiled as for users, not as in this suite.
    there = {name: text for name, text in os.environ.items() if name != "XLA_FLAGS"} | {"TRACKWRIGHT_CACHE": "off"}
    line = [sys.executable, "-m", "tests.released"]
    done = subprocess.run(line, cwd=ROOT, env=there, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
