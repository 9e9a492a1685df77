"""Instructions of hot paths against those kept, where valgrind and the versions are the same."""

from __future__ import annotations

import json
import shutil

import pytest

from tests.instructions import KEPT, counted, grown, lines, versions


@pytest.mark.slow
def test_no_hot_path_takes_a_tenth_more_instructions_than_kept():
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed")
    kept, here = json.loads(KEPT.read_text("utf-8")), versions()
    if kept["versions"] != here:
        pytest.skip(f"instructions are kept for {kept['versions']}, here {here}")
    found = {"versions": here, "instructions": counted()}
    assert not grown(kept, found), "\n".join(lines(kept, found))
