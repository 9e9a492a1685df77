"""Files of other programs beyond the limits of size, without an end, or outside of their bag: one line, at once."""

from __future__ import annotations

import os

import pytest

from tests.bags import write_bag
from tests.in_process import trackwright

POSES = ("--table", "truth", "--tag", "T")
BAG = ("--table", "truth", "--topic", "/vicon/cart", "--tag", "T")
SOURCES = {
    "log.csv": ("--table", "fixes", "--separator", ";"),
    "log.csv.gz": ("--table", "fixes"),
    "log.txt": ("--tag", "T", "--format", "dwm1001"),
    "path.tum": POSES,
    "path": POSES,
    "a.bag": BAG,
    "a.mcap": BAG,
    "a.db3": BAG,
}


@pytest.fixture(autouse=True)
def _rosbags():
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")


def _refused(*words):
    said = trackwright("import", *words)
    assert said.code == 2, said
    lines = [line for line in said.err.splitlines() if line.startswith("trackwright: ")]
    assert len(lines) == 1, said.err
    return lines[0]


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("what", ["large", "pipe", "/dev/zero"])
def test_a_large_table_and_a_file_without_an_end_are_refused_before_they_are_read(tmp_path, name, what):
    if what == "large":
        if SOURCES[name] is BAG or name == "path":
            pytest.skip("messages of bags are read one by one, of a file without ending the first lines")
        with (tmp_path / name).open("wb") as file:
            file.truncate(2**40)  # a hole: no byte is stored
    elif what == "pipe":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).symlink_to(what)
    words = _refused(tmp_path / name, *SOURCES[name], "--out", tmp_path / "out")
    assert ("holds more than" if what == "large" else "is a pipe or device, not a file") in words
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("outside", ["../other/other.mcap", "/proc/self/mem"])
def test_a_bag_reads_nothing_outside_its_folder(tmp_path, outside):
    write_bag(tmp_path / "bag", "mcap")
    write_bag(tmp_path / "other", "mcap")
    (tmp_path / "bag" / "bag.mcap").unlink()
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("bag.mcap", outside))
    assert "missing" in _refused(tmp_path / "bag", *BAG, "--out", tmp_path / "out")
