"""Commands that are killed: what they were writing is removed, and the same command goes on to the same bits."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from trackwright.trackers.recordings.atomic import PREFIX, atomic_write, remove_abandoned

WRITER = """
import os, signal, sys
from pathlib import Path
from trackwright.trackers.recordings.atomic import beside
path, make = Path(sys.argv[1]), getattr(Path, sys.argv[2])
with beside(path, make) as temporary:
    print("writing", flush=True)
    {then}
"""

STUDY = """
runs = 20000
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
rate_hz = 1.0
[trackers.fix-kf]
"""


def _temporary(out: Path) -> set[str]:
    """The temporary files of commands in a folder and in those inside it."""
    return {name for _, *names in os.walk(out) for name in (*names[0], *names[1]) if name.startswith(PREFIX)}


def _writer(path: Path, make: str, then: str) -> subprocess.Popen:
    """A process that makes a temporary file or folder beside the path, and then does something."""
    line = [sys.executable, "-c", WRITER.format(then=then), str(path), make]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stdin=subprocess.PIPE)
    assert process.stdout.readline() == b"writing\n"
    return process


@pytest.mark.parametrize("make", ["touch", "mkdir"])
def test_what_a_killed_process_was_writing_is_removed_and_what_a_running_one_writes_is_not(tmp_path, make):
    pytest.importorskip("fcntl")
    kill = "(temporary / 'x').touch() if temporary.is_dir() else 0; os.kill(os.getpid(), signal.SIGKILL)"
    with _writer(tmp_path / "a", make, kill) as dead:
        assert dead.wait(20) == -signal.SIGKILL
    left = _temporary(tmp_path)
    assert len(left) == 1
    with _writer(tmp_path / "b", make, "sys.stdin.read(); os.rename(temporary, path)") as alive:
        # The second writer has removed what the first one left.
        other = _temporary(tmp_path)
        assert len(other - left) == len(other) == 1
        remove_abandoned(tmp_path)
        atomic_write(tmp_path / "c", lambda path: path.write_text("c"))
        assert _temporary(tmp_path) == other
        alive.stdin.close()
        assert alive.wait(20) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b", "c"]


def _chunks(out: Path) -> set[tuple[str, int]]:
    return {(path.name, path.stat().st_ino) for path in out.glob("chunks/[0-9]*.npz")}


@pytest.mark.slow
def test_a_study_that_is_killed_goes_on_without_losing_a_chunk_to_the_same_bits(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY, "utf-8")
    words = ["study", str(tmp_path / "study.toml"), "--out"]
    whole, out = tmp_path / "whole", tmp_path / "killed"
    line = [sys.executable, "-m", "trackwright", *words]
    subprocess.run([*line, str(whole)], check=True, capture_output=True)
    with subprocess.Popen([*line, str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and len(_chunks(out)) < len(_chunks(whole)) // 2:
            time.sleep(0.01)
        process.kill()
    before = _chunks(out)
    assert 0 < len(before) < len(_chunks(whole))
    subprocess.run([*line, str(out)], check=True, capture_output=True)
    assert before <= _chunks(out)
    assert not _temporary(out)
    one, other = (json.loads((x / "results.json").read_text("utf-8"))["sha256"] for x in (whole, out))
    assert one == other
