"""The page on importing: its commands are run in order on files as it describes them, and so is its Python code."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.bags import write_bag
from tests.in_process import assert_refused_last, trackwright

PAGE = Path(__file__).parents[1] / "docs" / "import.md"
LINE = "1151[5.00,8.00,2.25]=6.48 0CA8[0.00,8.00,2.25]=6.51 est[2.57,1.98,1.68,100]"


def _blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """A folder with the files that the page names; it is the current one."""
    pytest.importorskip("rosbags", reason="rosbags is not installed; the extra ros has it")
    anchors = {"A1": (0.0, 0.0, 2.0), "A2": (6.0, 0.0, 2.5), "0x0F": (0.0, 5.0, 2.2), "A4": (6.0, 5.0, 2.1)}
    anchors |= {"1151": (5.0, 8.0, 2.25), "0CA8": (0.0, 8.0, 2.25)}
    lines = "".join(f"{name} = {list(place)}\n" for name, place in anchors.items())
    (tmp_path / "rig.toml").write_text(f'format = 1\nname = "hall"\n[anchors]\n{lines}')
    times = np.arange(0, 200) * 0.05
    way = np.stack([3 + np.cos(0.6 * times), 2.5 + np.sin(0.9 * times), 1 + 0 * times], axis=1)
    rows = [
        f"{1000 * t:.0f},{name},{1000 * np.linalg.norm(place - np.array(at)):.0f}"
        for t, place in zip(times, way, strict=True)
        for name, at in anchors.items()
    ]
    (tmp_path / "log.csv").write_text("stamp,id,distance\n" + "\n".join(rows) + "\n")
    for name, shift, late in (("mocap.tum", 0.0, 0.0), ("mine.tum", 0.5, 0.2)):
        text = "".join(f"{t + late} {x + shift} {y} {z} 0 0 0 1\n" for t, (x, y, z) in zip(times, way, strict=True))
        (tmp_path / name).write_text(text)
    (tmp_path / "tag.log").write_text("".join(f"12:00:0{k}.5 {LINE}\n" for k in range(5)))
    (tmp_path / "anchors.toml").write_text("format = 1\n[anchors]\n17 = [0.0, 0.0, 2.0]\n42 = [5.0, 0.0, 2.0]\n")
    (tmp_path / "my.log").write_text("booted\n@12.5;A1=271;A2=402\n@12.25;0x0F=305\n")
    for block in (*_blocks("toml"), *(block for block in _blocks("python") if block.startswith("# "))):
        (tmp_path / block.split()[1]).write_text(block)
    write_bag(tmp_path / "run", "mcap")
    (tmp_path / "run" / "run.mcap").rename(tmp_path / "run.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_every_command_of_the_page_runs_on_the_files_that_it_describes(files):
    # The truth stands further down the page than the first command that reads it.
    commands = [shlex.split(line) for block in _blocks("sh") for line in block.splitlines()]
    commands.sort(key=lambda words: words[1] != "import")
    assert len(commands) >= 10
    said = {}
    for words in commands:
        assert words[0] == "trackwright"
        said[" ".join(words[1:3])] = done = trackwright(*words[1:])
        assert done.code == 0, (words, done.err)
    assert "time offset -0.2" in said["evaluate mine.tum"].out
    assert (files / "tracks.tum").is_file()
    ranges = pl.read_parquet("hall-own/ranges.parquet")
    assert ranges.select("t_s", "tag", "anchor", "range_m").rows()[:2] == [
        (12.25, "T1", "0x0F", 3.05),
        (12.5, "T1", "A1", 2.71),
    ]


FIXES = "{'fixes': pl.DataFrame({'t_s': [%s], 'x_m': [%s], 'y_m': [0.0], %s})}"


@pytest.mark.parametrize(
    ("returned", "word"),
    [
        ("3", "gave int of my.log"),
        ("{'ranges': [1, 2]}", "ranges: found list; expected a pandas or polars frame"),
        ("{'range': pl.DataFrame({'t_s': [0.0]})}", "table 'range'; expected one of ranges"),
        ("{'ranges': pl.DataFrame({'t_s': [0.0], 'anchor': ['A1']})}", "ranges needs range_m"),
        (FIXES % ("None", "0.0", "'z_m': [0.0]"), "row 1, column t_s: empty, expected seconds"),
        (FIXES % ("0.0", "'a'", "'z_m': [0.0]"), "column x_m: 'a'"),
        (FIXES % ("0.0", "0.0", "'q': [0.0]"), "an empty column where none is measured"),
        ("path.read()", "my.log: bad.py:own fails (AttributeError in line 5:"),
    ],
)
def test_what_a_format_of_ones_own_returns_is_refused_in_a_line(tmp_path, monkeypatch, returned, word):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.log").write_text("@12.5;A1=271\n")
    (tmp_path / "bad.py").write_text(f"import polars as pl\n\n\ndef own(path):\n    return {returned}\n")
    said = trackwright("import", "my.log", "--format", "bad.py:own", "--tag", "T1", "--out", "new")
    assert_refused_last(said, "bad.py:own", word)
    assert not (tmp_path / "new").exists()


def test_the_python_code_of_the_page_runs(tmp_path, monkeypatch):
    pytest.importorskip("pandas", reason="pandas is not installed; make test installs it")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "import"}
    for block in (block for block in _blocks("python") if not block.startswith("# ")):
        exec(compile(block, str(PAGE), "exec", dont_inherit=True), names)
    assert names["recording"].tables["ranges"]["range_m"].to_list() == [2.71, 4.025, 2.735]
    assert names["errors"].ape_m["rmse"] == pytest.approx(0.5)
    assert len(names["again"]) == len(names["mine"])
