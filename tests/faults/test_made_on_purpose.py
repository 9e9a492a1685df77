"""Faults made on purpose: commands killed, workers that die or hang, disks that are full; `table.py` tries many."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.faults import disks, table, workers
from tests.faults.jobs import Ended, Job, half_written, jobs, temporary
from tests.faults.seen import Seen, UntriedError
from trackwright.trackers.recordings.atomic import PREFIX, atomic_write, beside, remove_abandoned

WRITER = """
import os, signal, sys
from pathlib import Path
from trackwright.trackers.recordings.atomic import beside
path, make = Path(sys.argv[1]), getattr(Path, sys.argv[2])
with beside(path, make) as temporary:
    print("writing", flush=True)
    {then}
"""


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
    left = temporary(tmp_path)
    assert len(left) == 1
    with _writer(tmp_path / "b", make, "sys.stdin.read(); os.rename(temporary, path)") as alive:
        # The second writer has removed what the first one left.
        other = temporary(tmp_path)
        assert len(other - left) == len(other) == 1
        remove_abandoned(tmp_path)
        atomic_write(tmp_path / "c", lambda path: path.write_text("c"))
        assert temporary(tmp_path) == other
        alive.stdin.close()
        assert alive.wait(20) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b", "c"]


def test_a_file_that_is_taken_for_abandoned_before_it_is_locked_is_made_again(tmp_path):
    pytest.importorskip("fcntl")
    taken = []

    def make(path):
        path.touch()
        if not taken:
            taken.append(path)
            remove_abandoned(tmp_path)
            assert not path.exists()

    with beside(tmp_path / "a", make) as path:
        assert path.exists()
        remove_abandoned(tmp_path)
        assert path.exists()
    assert taken
    assert not [*tmp_path.iterdir()]


def test_files_of_others_are_not_taken_for_abandoned(tmp_path):
    (tmp_path / ".hidden").touch()
    (tmp_path / "target").touch()
    (tmp_path / f"{PREFIX}link").symlink_to(tmp_path / "target")
    remove_abandoned(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", f"{PREFIX}link", "target"]


def _random(name):
    return np.random.default_rng([*name.encode()])


@pytest.mark.parametrize("tried", [disks.full, disks.read_only])
def test_a_bad_disk_is_refused_in_a_line_and_costs_nothing(tmp_path, tried):
    try:
        seen = tried("track", 1, _random("track"), tmp_path)
    except UntriedError as reason:
        pytest.skip(str(reason))
    assert not seen.faults


SLOW = {fault.name: fault for fault in table.faults(4000, 2)}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SLOW if "hangs" not in name])
def test_no_fault_costs_a_bit_or_a_finished_part(name):
    pytest.importorskip("distributed")
    try:
        seen = table.tried(SLOW[name], 1, min(SLOW[name].times, 2))
    except UntriedError as reason:
        pytest.skip(str(reason))
    assert not seen.faults


@pytest.mark.slow
def test_a_worker_that_hangs_is_ended(tmp_path):
    pytest.importorskip("distributed")
    assert not workers.hangs(1, _random("hangs"), tmp_path, 4000, silent_s=15).faults


@pytest.mark.slow
def test_files_of_every_kind_that_lost_their_end_are_seen(tmp_path):
    done = jobs(tmp_path)
    for name in ("track", "tune", "study"):
        assert disks._here(done[name], tmp_path / name).code == 0
        assert not half_written(tmp_path / name)
        for path in [path for path in (tmp_path / name).rglob("*") if path.is_file()]:
            whole = path.read_bytes()
            path.write_bytes(whole[: len(whole) // 2].rstrip(b"\n"))
            assert half_written(tmp_path / name) == [str(path.relative_to(tmp_path / name))]
            path.write_bytes(whole)


def test_what_must_not_be_is_a_failure(tmp_path):
    assert Seen().faults == ["never tried: 1", "nothing compared: 1"]
    assert not Seen(times=1, compared=1).faults
    for name in ("lost", "half", "left", "differ"):
        assert Seen(times=1, compared=1, **{name: 1}).faults
    seen = Seen()
    for ended in (Ended(0, "", ""), Ended(2, "", "Traceback\n"), Ended(2, "", "trackwright: a\nmore\n")):
        seen.refused(ended, tmp_path)
    assert len(seen.wrong) == 3
    seen.refused(Ended(2, "", f"trackwright: {tmp_path}/a: no\n"), tmp_path, 2, "no")
    assert (len(seen.wrong), seen.said) == (3, {"a: no"})
    seen.compare(Job("track", (), ()), tmp_path, "", Ended(2, "", "no"))
    assert len(seen.wrong) == 4


def test_the_page_has_the_table_that_was_kept():
    page = (Path(__file__).parents[2] / "docs/faults.md").read_text("utf-8")
    kept = json.loads(table.RESULTS.read_text("utf-8"))
    assert {*kept} <= {fault.name for fault in table.faults()}
    assert table.markdown(kept) in page
    assert not [name for name, found in kept.items() if found["wrong"]]
