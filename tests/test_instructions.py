"""Instructions of hot paths against those kept, where valgrind and the versions are the same."""

from __future__ import annotations

import json
import shutil

import pytest

from tests.instructions import KEPT, counted, grown, lines, versions


def test_a_path_that_takes_a_tenth_more_is_named_and_other_versions_are():
    kept = {"versions": {"numpy": "2.0"}, "instructions": {"filter": 100_000_000, "evaluate": 50_000_000}}
    found = {"versions": {"numpy": "2.1"}, "instructions": {"filter": 109_000_000, "evaluate": 56_000_000}}
    assert grown(kept, found) == ["evaluate"]
    head, first, second = lines(kept, found)
    assert "numpy 2.0" in head
    assert "(+9.0%)" in first
    assert "(+12.0%)" in second


@pytest.mark.slow
def test_no_hot_path_takes_a_tenth_more_instructions_than_kept():
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed")
    kept, here = json.loads(KEPT.read_text("utf-8")), versions()
    if kept["versions"] != here:
        pytest.skip(f"instructions are kept for {kept['versions']}, here {here}")
    found = {"versions": here, "instructions": counted()}
    assert not grown(kept, found), "\n".join(lines(kept, found))
