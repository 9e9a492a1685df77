"""Atomic writes, strict JSON, and the manifest of a run."""

import errno
import json
import math
from pathlib import Path

import numpy as np
import pytest

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import (
    PREFIX,
    atomic_write,
    beside,
    json_text,
    remove_abandoned,
)


def _half_then(error):
    def write(path):
        path.write_text("half")
        raise error

    return write


def test_a_full_disk_leaves_the_old_file_and_no_partial_one(tmp_path):
    (tmp_path / "out.json").write_text("old")
    with pytest.raises(UnusableInput, match=r"cannot write .*out\.json: No space left on device"):
        atomic_write(tmp_path / "out.json", _half_then(OSError(errno.ENOSPC, "No space left on device")))
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]
    assert (tmp_path / "out.json").read_text() == "old"


@pytest.mark.parametrize("error", [ValueError("a bug"), KeyboardInterrupt()])
def test_any_other_failure_is_raised_and_leaves_no_partial_file(tmp_path, error):
    with pytest.raises(type(error)):
        atomic_write(tmp_path / "out.json", _half_then(error))
    assert list(tmp_path.iterdir()) == []


def test_json_is_strict_and_takes_arrays():
    value = {"a": np.float32(0.5), "b": np.arange(2), "c": math.nan, "d": Path("x"), 3: (math.inf, True, None, "é")}
    parsed = json.loads(json_text(value), parse_constant=pytest.fail)
    assert parsed == {"a": 0.5, "b": [0, 1], "c": None, "d": "x", "3": [None, True, None, "é"]}


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
