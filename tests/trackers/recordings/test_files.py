"""Files: written whole or not at all, and refused in one line where nothing can be read from them."""

from __future__ import annotations

import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.faulty import RIG, write_good
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.files import atomic_write, json_text, read_arrays, read_toml
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.tracks_table import require_output


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), UnusableInput),
        (ValueError("a bug"), ValueError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_failure_leaves_the_old_file_and_no_partial_one(tmp_path, error, raised):
    def half(path):
        path.write_text("half")
        raise error

    (tmp_path / "out.json").write_text("old")
    with pytest.raises(raised):
        atomic_write(tmp_path / "out.json", half)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("out.json", "old")]


def test_json_is_strict_and_takes_arrays():
    value = {"a": np.float32(0.5), "b": np.arange(2), "c": math.nan, "d": Path("x"), 3: (math.inf, True, None, "é")}
    parsed = json.loads(json_text(value), parse_constant=pytest.fail)
    assert parsed == {"a": 0.5, "b": [0, 1], "c": None, "d": "x", "3": [None, True, None, "é"]}


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (b"x = " + b"[" * 5000, "nested too deeply"),
        (b"x = " + b"9" * 5000, "not valid TOML: Exceeds the limit"),
        (b"x = 1\nx = 2", "Cannot overwrite a value"),
        ("x = 'é'".encode("latin-1"), "can't decode byte 0xe9 in position 5"),
    ],
)
def test_toml_that_breaks_its_reader_is_one_line(tmp_path, text, word):
    path = tmp_path / "file.toml"
    path.write_bytes(text)
    with pytest.raises(UnusableInput, match=word):
        read_toml(path, "a study")


@pytest.mark.parametrize("name", ["ranges.csv", "rig.toml"])
@pytest.mark.parametrize("what", ["pipe", "/dev/zero", "itself"])
def test_a_file_without_an_end_is_refused_at_once(tmp_path, name, what):
    write_good(tmp_path / "good")
    path = tmp_path / "good" / name
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(path if what == "itself" else what)
    expected = "Too many levels of symbolic links" if what == "itself" else "is a pipe or device, not a file"
    with pytest.raises(UnusableInput, match=rf"{name}: cannot be read \({expected}\)"):
        read_recording(tmp_path / "good")


def test_control_characters_are_refused_in_ids_names_and_folders(tmp_path):
    write_good(tmp_path / "good")
    table = pl.read_csv(tmp_path / "good" / "ranges.csv")
    (tmp_path / "good" / "ranges.csv").unlink()
    bad = pl.when(pl.int_range(pl.len()) == 4).then(pl.lit("T\x1b[31m")).otherwise(pl.col("tag"))
    table.with_columns(tag=bad).write_parquet(tmp_path / "good" / "ranges.parquet")
    with pytest.raises(UnusableInput, match="row 5, column tag: .* without the control character"):
        read_recording(tmp_path / "good")
    (tmp_path / "good" / "ranges.parquet").unlink()
    (tmp_path / "good" / "rig.toml").write_text(RIG.replace("tags.T2", r'tags."a\u001b"'))
    with pytest.raises(UnusableInput, match="rig.toml: .* has a control character"):
        read_recording(tmp_path / "good")
    folder = tmp_path / os.fsdecode(b"rec\xff")
    (tmp_path / "good").rename(folder)
    with pytest.raises(UnusableInput, match="has a control character or bytes that are no UTF-8 in its name"):
        read_recording(folder)
    with pytest.raises(UnusableInput, match="--out .* has a control character"):
        require_output(folder / "out")


def test_a_damaged_archive_of_arrays_is_a_value_error(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.zeros(10), y=np.arange(3))
    assert {name: x.tolist() for name, x in read_arrays(path).items()} == {"x": [0.0] * 10, "y": [0, 1, 2]}
    whole = path.read_bytes()
    for data in (b"", whole[:50], whole[:-60], bytes([whole[0] ^ 255]) + whole[1:]):
        path.write_bytes(data)
        with pytest.raises(ValueError, match="zip|data"):
            read_arrays(path)
