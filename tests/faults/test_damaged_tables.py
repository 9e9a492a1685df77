"""Damaged recordings through the command line: read, or refused in a line; no traceback, nothing left behind."""

from __future__ import annotations

import re

import pytest

from tests.faults.recordings import broken_recording
from tests.in_process import trackwright


def _wrong(words, folder, out):
    """What is wrong with a run on a damaged recording; empty for nothing."""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    try:
        said = trackwright(*words)
    except BaseException as error:  # everything that leaves `main` is a fault
        return f"{type(error).__name__}: {error}"
    lines, wrong = said.err.splitlines(), []
    refusals = [line for line in lines if line.startswith("trackwright: ")]
    wrong += [f"exit code {said.code}"] * (said.code not in (0, 1, 2))
    wrong += [f"not refused in one line: {lines[-3:]}"] * (said.code == 2 and refusals != lines[-1:])
    wrong += [f"printed {said.err[:300]!r}"] * bool(re.search(r"Traceback|Warning:|[\x00-\x08\x0b-\x1f\x7f]", said.err))
    wrong += ["changed its input"] * ({path: path.read_bytes() for path in folder.iterdir()} != before)
    wrong += ["left files"] * (said.code == 2 and out.exists() and any(out.iterdir()))
    return "; ".join(wrong)


MANY = [pytest.param(*one, marks=pytest.mark.slow) for one in (("check", 1000), ("track", 60))]


@pytest.mark.parametrize(("command", "count"), [("check", 25), *MANY])
def test_a_damaged_recording_is_read_or_refused_in_a_line(command, count, tmp_path):
    failed, out = [], tmp_path / "out"
    for number in range(count):
        (tmp_path / str(number)).mkdir()
        folder, faults = broken_recording(int(command == "track"), number, tmp_path / str(number))
        words = (
            ("check", folder)
            if command == "check"
            else ("track", folder, "--tracker", "fix-kf", "--figures", "none", "--out", out / str(number))
        )
        if wrong := _wrong(words, folder, out / str(number)):
            failed.append(f"{number}: {faults}: {wrong}")
    assert not failed
