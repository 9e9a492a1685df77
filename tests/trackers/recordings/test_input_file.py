"""Files beyond the limits of size, files without an end, and TOML that breaks its reader: one line each, at once."""

from __future__ import annotations

import gzip
import os

import numpy as np
import polars as pl
import pytest

from tests.faulty import RIG, write_good
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings import input_file
from trackwright.trackers.recordings.archives import require_output
from trackwright.trackers.recordings.calibration import read_calibration
from trackwright.trackers.recordings.folder import read_recording
from trackwright.trackers.recordings.table_file import read_table_file
from trackwright.tuning.tuned_file import read_tuned


@pytest.fixture
def small_limit(monkeypatch):
    monkeypatch.setattr(input_file, "LARGEST", 3 * 2**20)


def _bomb() -> bytes:
    """Some gzip data of 60 kB that unpack to 20 MB."""
    return gzip.compress(b"t_s,tag,anchor,range_m\n" + b"0.1,T1,A1,1.0\n" * 1_500_000)


def test_a_gzip_bomb_is_refused_without_unpacking_it(tmp_path, small_limit):
    path = tmp_path / "ranges.csv.gz"
    path.write_bytes(_bomb())
    assert path.stat().st_size < 10**5
    with pytest.raises(UnusableInput, match=r"ranges.csv.gz: cannot be read \(holds more than 0.0 GB; split it\)"):
        read_table_file(path)


def test_gzip_data_of_several_members_and_below_the_limit_are_whole(tmp_path, small_limit):
    path = tmp_path / "ranges.csv.gz"
    rows = b"0.1,T1,A1,1.0\n" * 100_000
    path.write_bytes(gzip.compress(b"t_s,tag,anchor,range_m\n") + gzip.compress(rows))
    assert read_table_file(path).frame.height == 100_000


def test_a_large_file_is_refused_before_it_is_read(tmp_path, small_limit):
    path = tmp_path / "ranges.csv"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: no byte is stored
    with pytest.raises(UnusableInput, match="holds more than"):
        read_table_file(path)


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


@pytest.mark.parametrize("read", [read_tuned, read_calibration, lambda path: input_file.read_toml(path, "a study")])
@pytest.mark.parametrize(
    ("text", "word"),
    [
        (b"x = " + b"[" * 5000, "nested too deeply"),
        (b"x = " + b"9" * 5000, "not valid TOML: Exceeds the limit"),
        (b"x = 1\nx = 2", ": line 2: x is given twice; expected it once"),
        (b'[tags]\n[anchors]\n"A 1" = 1\n[tags]', ": line 4: tags is given twice"),
        ("x = 'é'".encode("latin-1"), "not UTF-8 text at byte 5"),
    ],
)
def test_toml_that_breaks_its_reader_is_one_line(tmp_path, read, text, word):
    path = tmp_path / "file.toml"
    path.write_bytes(text)
    with pytest.raises(UnusableInput, match=word):
        read(path)


@pytest.mark.parametrize("bad", ["T\x1b[31m", "T\x001", "T\n1"])
def test_an_id_with_a_control_character_is_refused(tmp_path, bad):
    write_good(tmp_path / "good")
    table = pl.read_csv(tmp_path / "good" / "ranges.csv")
    changed = table.with_columns(tag=pl.when(pl.int_range(pl.len()) == 4).then(pl.lit(bad)).otherwise(pl.col("tag")))
    changed.write_parquet(tmp_path / "good" / "ranges.parquet")
    (tmp_path / "good" / "ranges.csv").unlink()
    with pytest.raises(UnusableInput, match="row 5, column tag: .* has a control character"):
        read_recording(tmp_path / "good")
    (tmp_path / "good" / "ranges.parquet").unlink()
    (tmp_path / "good" / "rig.toml").write_text(RIG.replace("tags.T2", r'tags."a\u001b"'))
    with pytest.raises(UnusableInput, match="rig.toml: .* has a control character"):
        read_recording(tmp_path / "good")


def test_a_number_of_the_rig_beyond_all_coordinates_is_refused(tmp_path):
    write_good(tmp_path / "good")
    (tmp_path / "good" / "rig.toml").write_text(RIG.replace("[6.0, 0.0, 2.6]", "[1e308, 0.0, 2.6]"))
    with pytest.raises(
        UnusableInput, match=r"anchors.A2 = \[1e\+308, 0.0, 2.6\], expected finite numbers, at most 1e\+09"
    ):
        read_recording(tmp_path / "good")


@pytest.mark.parametrize("name", [b"rec\xff", b"a\nb", b"\x1b[31m"])
def test_a_folder_whose_name_no_list_of_recordings_can_hold_is_refused(tmp_path, name):
    write_good(tmp_path / "good")
    folder = tmp_path / os.fsdecode(name)
    (tmp_path / "good").rename(folder)
    with pytest.raises(UnusableInput, match="has a control character or bytes that are no UTF-8 in its name"):
        read_recording(folder)
    with pytest.raises(UnusableInput, match="--out .* has a control character"):
        require_output(folder / "out")


def test_a_zip_bomb_and_a_broken_archive_hold_no_arrays(tmp_path, small_limit):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, x=np.zeros(10**6), y=np.arange(3))
    assert path.stat().st_size < 10**5
    with pytest.raises(ValueError, match="holds more than"):
        input_file.read_arrays(path)
    np.savez_compressed(path, x=np.zeros(10), y=np.arange(3))
    assert {name: x.tolist() for name, x in input_file.read_arrays(path).items()} == {"x": [0.0] * 10, "y": [0, 1, 2]}
    whole = path.read_bytes()
    for k in range(0, len(whole), 7):
        path.write_bytes(whole[:k] + bytes([whole[k] ^ 255]) + whole[k + 1 :])
        try:
            input_file.read_arrays(path)
        except ValueError:
            continue
    np.save(path.with_suffix(".npy"), np.arange(3))
    with pytest.raises(ValueError, match="not a zip file"):
        input_file.read_arrays(path.with_suffix(".npy"))
