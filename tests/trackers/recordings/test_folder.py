"""Recording folders: round trip, refusal of broken folders, notices of anomalies."""

from __future__ import annotations

import errno
import gzip
from pathlib import Path

import polars as pl
import pytest

from tests.broken import BROKEN
from tests.faulty import RIG, good_tables, write_good
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.trackers.recordings.rig_file import rig_text

KINDS, IDS = ("parquet", "csv.gz", "csv"), ("tag", "anchor", "station")


@pytest.fixture
def good(tmp_path: Path) -> RecordingFolder:
    write_good(tmp_path / "good")
    return read_recording(tmp_path / "good")


def test_a_good_recording_reads_without_a_notice(good: RecordingFolder):
    assert good.notices == ()
    assert good.name == "good"
    assert good.rig.about == "Made for tests."
    assert set(good.tables) == {"ranges", "fixes", "bearings", "phases", "imu", "truth"}
    for name, table in good_tables().items():
        read = good.tables[name]
        assert dict(read.schema) == {c: pl.String if c in IDS else pl.Float64 for c in read.columns}
        assert read.equals(table.select(read.columns))


@pytest.mark.parametrize("kind", KINDS)
def test_a_written_recording_reads_back_the_same(good: RecordingFolder, tmp_path: Path, kind):
    write_recording(good, tmp_path / "copy", kind)
    copy = read_recording(tmp_path / "copy")
    assert rig_text(copy.rig) == rig_text(good.rig)
    assert list(copy.tables) == list(good.tables)
    for name, table in good.tables.items():
        assert copy.tables[name].equals(table), name
    assert copy.notices == ()


def test_ids_and_texts_with_special_characters_survive_a_round_trip(tmp_path: Path):
    write_good(tmp_path / "a")
    rig = RIG.replace("Made for tests.", "Two\\nlines, a tab\\t, a delete\\u007f.")
    (tmp_path / "a" / "rig.toml").write_text(rig.replace('"A1"', '"A1 \\"left\\" \\\\ ü.1"'))
    for table in ("ranges", "truth"):
        (tmp_path / "a" / f"{table}.csv").unlink()
    first = read_recording(tmp_path / "a")
    assert 'A1 "left" \\ ü.1' in first.rig.anchors
    write_recording(first, tmp_path / "b")
    assert rig_text(read_recording(tmp_path / "b").rig) == rig_text(first.rig)


def test_empty_cells_and_nan_are_missing(tmp_path: Path):
    write_good(tmp_path / "a")
    file = tmp_path / "a" / "fixes.csv"
    lines = file.read_text().splitlines()
    head = lines[0].split(",")
    for row, text in ((1, ""), (2, "NaN"), (3, " nan "), (4, "  ")):
        cells = lines[row].split(",")
        cells[head.index("z_m")] = text
        lines[row] = ",".join(cells)
    file.write_text("\n".join(lines))
    assert read_recording(tmp_path / "a").tables["fixes"]["z_m"].is_null().arg_true().to_list() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "spell",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace(",", " , "),
        lambda text: text.replace("\n", "\n\n", 30) + "\n\n",
        lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.splitlines()),
        lambda text: text.rstrip("\n"),
    ],
    ids=["byte order mark", "CRLF", "CR", "spaces", "blank lines", "quotes", "no last line end"],
)
def test_other_spellings_of_csv_read_the_same(good: RecordingFolder, tmp_path: Path, spell):
    write_good(tmp_path / "a")
    file = tmp_path / "a" / "ranges.csv"
    file.write_bytes(spell(file.read_text()).encode())
    other = read_recording(tmp_path / "a")
    assert other.tables["ranges"].equals(good.tables["ranges"])
    assert other.notices == ()


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_recording_is_refused_in_one_line_that_names_the_file(tmp_path: Path, name, capfd):
    word = BROKEN[name](tmp_path / "recording")
    with pytest.raises(UnusableInput) as caught:
        read_recording(tmp_path / "recording")
    message = str(caught.value)
    assert word in message
    assert str(tmp_path / "recording") in message
    assert message.isprintable()  # so it has no line end either
    assert len(message) < len(str(tmp_path)) + 320
    assert capfd.readouterr() == ("", "")


def test_unknown_columns_and_tables_of_a_recording_are_one_notice(tmp_path: Path):
    write_good(tmp_path / "a")
    for name in ("ranges", "bearings"):
        good_tables()[name].with_columns(remark=pl.lit("good")).write_csv(tmp_path / "a" / f"{name}.csv")
    (tmp_path / "a" / "pressure.csv").write_text("t_s,tag,pressure_pa\n0,T1,1\n")
    (notice,) = read_recording(tmp_path / "a").notices
    assert all(word in notice for word in ("ignored: pressure.csv", "'remark' of bearings.csv", "of ranges.csv"))


def test_columns_of_signal_quality_are_kept_and_averaged_and_none_becomes_a_standard_deviation(tmp_path: Path):
    write_good(tmp_path / "a")
    # Also under names of columns that programs add for themselves.
    numbers = pl.int_range(pl.len()).cast(float)
    ranges = good_tables()["ranges"].with_columns(numbers.alias(name) for name in ("row", "stream", "interval"))
    ranges.reverse().write_csv(tmp_path / "a" / "ranges.csv")
    recording = read_recording(tmp_path / "a")
    kept = recording.tables["ranges"].sort("row")
    assert kept.equals(ranges)
    averages, first = recording.averaged(0.5).tables["ranges"], kept.row(0, named=True)
    together = kept.filter(pl.col("t_s") < 0.5, *(pl.col(of) == first[of] for of in ("tag", "anchor")))
    assert averages["interval"][0] == pytest.approx(together["interval"].mean())
    ranges.rename({"stream": "skew_std"}).write_csv(tmp_path / "a" / "ranges.csv")
    with pytest.raises(UnusableInput, match="unknown column 'skew_std', expected range_std_m"):
        read_recording(tmp_path / "a")


def test_rows_out_of_order_are_sorted_and_rows_of_one_time_keep_theirs(tmp_path: Path):
    write_good(tmp_path / "a")
    table = good_tables()["ranges"]
    pl.concat([table[96:], table[:96]]).write_csv(tmp_path / "a" / "ranges.csv")
    read = read_recording(tmp_path / "a").tables["ranges"]
    assert read.equals(table.select(read.columns))


@pytest.mark.parametrize("what", ["iterdir", "open"])
def test_a_refusal_by_the_system_is_one_line(good: RecordingFolder, monkeypatch, what):
    def refuse(path, *mode):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, what, refuse)
    with pytest.raises(UnusableInput, match="cannot be read \\(Permission denied\\)"):
        read_recording(good.path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_leaves_nothing_half_written(good: RecordingFolder, tmp_path: Path, monkeypatch, kind):
    calls = []

    def fills_up(path, *given):
        calls.append(path)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(*((pl.DataFrame, "write_parquet") if kind == "parquet" else (Path, "write_bytes")), fills_up)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(UnusableInput, match="No space left on device"):
        write_recording(good, tmp_path / "out", kind)
    assert len(calls) == 3
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_that_is_not_empty_is_not_overwritten(good: RecordingFolder, tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(UnusableInput, match="not empty"):
        write_recording(good, tmp_path / "out")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["mine.txt"]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UnusableInput, match="is a file"):
        write_recording(good, tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_the_same_recording_gives_the_same_bytes(good: RecordingFolder, tmp_path: Path):
    for name in "ab":
        write_recording(good, tmp_path / name, "csv.gz")
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()
    assert gzip.decompress((tmp_path / "a" / "truth.csv.gz").read_bytes()).startswith(b"t_s,tag,x_m,y_m,z_m,qw")
