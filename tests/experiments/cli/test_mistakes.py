"""Mistakes at every door of the command line: exit code 2, one line with the expected phrases, nothing written."""

from __future__ import annotations

import shutil
from itertools import cycle

import numpy as np
import polars as pl
import pytest

from tests.broken import BROKEN
from tests.faulty import good_tables, then, with_table, write_good
from tests.in_process import PLAIN, assert_refused_last, trackwright
from trackwright.tuning.checkpoint import save

SWEEP = "sweep {fixes} --tracker fix-kf --out out --over sensors.fixes.sigma_horizontal="
TUNE = "tune {simulated} --tracker beam --out out "
POSES = "evaluate {tum} --truth {good} "

MISTAKES = [
    ("trak x", 'Unknown command "trak". Did you mean "track"?', "See `trackwright --help`"),
    ("simulate-line", 'Did you mean "simulate"?'),
    ("simulate lines", 'Unknown command "lines". Did you mean "line"?'),
    ("track --out out", "RECORDINGS requires an argument", "See `trackwright track --help`"),
    ("track x --out out --nose f", "Unknown option: --nose. Did you mean --noise?"),
    ("track x --out /", "--out /: is the root of the file system"),
    ("track x --out out --lag 0", 'Invalid value "0.0" for --lag. expected seconds above zero'),
    ("track x --out out --seed -1", '"-1" for --seed. expected a whole number from 0 to 2^64 - 1'),
    ("track x --out out --set sigma", "--set sigma: expected NAME=VALUE"),
    ("track {good} --out out --from 9 --to 3", "has no row in the span of time asked for"),
    ("track x --out=", 'unable to convert "" into'),
    ("trackers uwb", "give a recording FOLDER, too"),
    ("track x --out out --noise nowhere.toml", "nowhere.toml: cannot be read"),
    ("track x --out out --figures svg", 'Choose from: "none", "page", "png", "pdf"'),
    ("track {good} {copy} --out out", "both named 'good'", "rename"),
    ("track {good} {tracked}/../good --out out", "given more than once"),
    ("track {good} --tracker kalman --out out", "tracker kalman: unknown", "direct, cascade, beam, das"),
    ("track {good} --tracker mhk,imm --out out", "found 2 names; expected one; `evaluate A B` compares"),
    ("track {good} --tracker trilateration --out out", "height_m in rig.toml for every tag, found none for T2"),
    ("track {simulated} --tracker beam --out {simulated}", "--out", "is a recording folder"),
    ("track {simulated} --tracker bearings --out out", "'bearings' needs a bearings table", "phases, truth"),
    ("track {simulated} --tracker cascade --smooth --out out", "Kalman filters"),
    ("track {simulated} --tracker beam --out out --set sigma_q=1", "--set: this tracker has no 'sigma_q'"),
    ("track {simulated} --tracker beam --out out --set *.sigma_p=-1", "is positive"),
    ("track {fixes} --tracker floor-pf --out out", "floor-pf", "[floor]", "walls_m or outline_m"),
    ("track {fixes} --tracker fix-mirror --out out", "fix-mirror", "at least 3 anchors"),
    ("track {fixes} --calibration {file} --out out", "no format, expected the calibration.toml"),
    ("tune {good} --tracker mhk,imm --out out", "found 2 names; expected one"),
    ("tune {good} --tracker bearings --out out", "2 different 'bearings' trackers", "free_height"),
    ("tune {simulated} --tracker das --out out", "no noise level of motion or sensors to tune", "no tunable"),
    ("tune {blind} --tracker fix-kf --objective rmse --out out", "objective rmse needs truth", "nll"),
    ("tune x --out out --force", "--force"),
    ("study nothing", "study 'nothing': unknown", "expected a .toml or .py file"),
    ("study a b", "words beyond what it takes: ['b']"),
    (TUNE + "--steps 0", "for --steps. expected at least 1"),
    (TUNE + "--steps 1.5", 'unable to convert "1.5" into int'),
    (TUNE + "--tune motion.sigma_q", "matches no tunable (did you mean motion.sigma_a?); this tracker has: motion.s"),
    (TUNE + "--tune tied:*", "ties tunables of different units or shapes"),
    (TUNE + "--bound nothing.*=1:2", "bound", "no tuned number matches"),
    (TUNE + "--bound motion.sigma_a=100:200", "motion.sigma_a begins outside, at "),
    (TUNE + "--bound motion.sigma_a=0.01:2 motion.sigma_a=0.1:1", "duplicate bound"),
    (TUNE + "--freeze *", "nothing to tune"),
    (TUNE + "--objective nll+best", "is no objective"),
    ("sweep {fixes} --tracker fix-kf --out out --over no.such=0.1:1:5", "no.such", "matches no tunable"),
    ("sweep x --out out --over a=0:1:5:log", "expected START above zero"),
    (SWEEP + "1:0.1:5", "expected PATTERN", "START below STOP"),
    (SWEEP + "-0.1:1:5", "a Scale is positive", "-0.1"),
    (SWEEP + "1:2:3 --over motion.sigma_a=1:2:3 --over a=1:2:3", "3 times", "once, or twice"),
    (SWEEP + "1:2:3 --over sensors.fixes.sigma_horizontal=1:2:3", "twice for different patterns"),
    (SWEEP + "1:2:3 --objective accuracy", "'accuracy' is no objective", "rmse"),
    ("evaluate {tracked} --fail-if rmse_m>50cm", "--fail-if", "no condition on metrics, expected NAME OPERATOR NUMBER"),
    ("evaluate {tracked} --fail-if p95>0.5", "--fail-if", "no metric 'p95' (did you mean p95_m?)"),
    ("evaluate {tracked} --from 99", "no estimate is of these tags and times"),
    ("evaluate {good}", "tracks.parquet: no such file", "track"),
    ("evaluate nowhere", "nowhere: no such file; expected a folder with tracks.parquet"),
    ("evaluate {tracked} --truth {simulated}", "the tracks are of recording good, the truth is of simulated-hand-0"),
    (POSES, "names no tag", "T1, T2", "--tag"),
    (POSES + "--tag T9", "the truth has T1, T2", "give one by --tag"),
    (POSES + "--tag T1 --time-offset 900", "no pose lies near in time", "both begin together"),
    (POSES + "--tag T1 --rpe 5km", "such as 1m"),
    ("evaluate {tum}", "--truth: found none"),
    ("evaluate {tum} --truth nowhere.tum", "--truth: found nowhere.tum", "or one trajectory file, that exist"),
    ("calibrate {good} --out {file}", "expected a file with the ending .toml"),
    ("calibrate {good} --out {good}/c.toml", "is a recording folder"),
    ("calibrate {blind} --out out/c.toml", "no truth table; expected truth to calibrate against"),
    ("export {tracked} --format tum --tag x --out out", "expected tags among T1, T2"),
    ("survey {good} --out r.toml --given A1,A2,X", "anchor 'X' has no readings"),
    ("survey {good} --out r.toml --sigma 0.1", "belongs to given positions"),
    ("survey {good} --out r.toml --frame A1,A2", "expected three different anchors"),
    ("survey {good} --out r.toml --height nan", "expected metres"),
    ("simulate station --out out --masked-antenna 1 9", "--masked-antenna"),
    ("simulate station --out {good}", "folder is not empty"),
    (f"simulate station --out out --seed={2**70}", "--seed ", "expected "),
    ("simulate station --out out --gauss-markov=inf", "--gauss-markov inf: ", "expected "),
    ("simulate station --out out --lost-station=4", "--lost-station 4: ", "expected "),
    ("simulate line --out out --speed=0.0", "--speed 0.0: ", "expected "),
]


@pytest.fixture(scope="module")
def there(beginnings, simulated, tmp_path_factory):
    """The places that the mistakes speak of, by name, in a folder that is left as it was."""
    folder = tmp_path_factory.mktemp("mistakes")
    write_good(folder / "copy")
    (folder / "fixes").mkdir()
    (folder / "fixes" / "rig.toml").write_text('format = 1\nname = "fixes"\n')
    good_tables()["fixes"].write_csv(folder / "fixes" / "fixes.csv")
    shutil.copytree(folder / "fixes", folder / "blind")
    good_tables()["truth"].write_csv(folder / "fixes" / "truth.csv")
    (folder / "file").write_text("[tunables]\n")
    truth = good_tables()["truth"].filter(tag="T1").select("t_s", "x_m", "y_m", "z_m", qx=0.0, qy=0.0, qz=0.0, qw=1.0)
    truth.write_csv(folder / "own.tum", include_header=False, separator=" ")
    made = {name: folder / name for name in ("copy", "fixes", "blind", "file")}
    given = {name: beginnings / name for name in ("good", "tracked")}
    return made | given | {"simulated": simulated, "tum": folder / "own.tum"}


def _contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake[0])
def test_a_mistake_is_one_line_and_changes_no_file(there, tmp_path, monkeypatch, mistake):
    monkeypatch.chdir(tmp_path)
    before = [_contents(path.parent) for path in there.values()]
    line, *phrases = mistake
    assert_refused_last(trackwright(*line.format(**there).split()), *phrases)
    assert [_contents(path.parent) for path in there.values()] == before
    assert not list(tmp_path.iterdir())


def _tracks(change):
    def changed(folder):
        change(pl.read_parquet(folder / "tracks.parquet")).write_parquet(folder / "tracks.parquet")

    return changed


def _file(name, content):
    return lambda folder: (folder / name).write_bytes(content)


BROKEN_RUNS = [
    (_file("tracks.parquet", bytes(range(256))), "is a broken Parquet file"),
    (_file("tracks.parquet", b""), "tracks.parquet: is a broken Parquet file"),
    (_tracks(lambda table: table.clear()), "no row; expected the table of `trackwright track`"),
    (_tracks(lambda table: table.drop("t_s")), "no column t_s"),
    (_tracks(lambda table: table.drop("x_m")), "no column x_m; expected the table of `trackwright track`"),
    (lambda folder: (folder / "recordings.txt").unlink(), "names no recording"),
    (_file("recordings.txt", b"\xff\xfe\x80"), "names no recording"),
    (_file("recordings.txt", b"/gone"), "gone does not exist; expected the recordings there; give --truth RECORDING"),
]


@pytest.mark.parametrize(("change", "word"), BROKEN_RUNS)
def test_a_run_folder_that_is_broken_is_refused(tmp_path, beginnings, change, word):
    shutil.copytree(beginnings / "tracked", tmp_path / "run")
    change(tmp_path / "run")
    before = _contents(tmp_path)
    assert_refused_last(trackwright("evaluate", tmp_path / "run"), word)
    assert _contents(tmp_path) == before


BAD_RECORDINGS = [
    ("folder does not exist", "track {} --out out"),
    ("rig broken TOML", "check {}"),
    ("truncated Parquet", "tune {} --out out"),
    ("text in a number", "evaluate {tracked} --truth {}"),
]


# All commands read with `read_recording`, with which tests/trackers/recordings tries each of BROKEN.
@pytest.mark.parametrize(("name", "line"), BAD_RECORDINGS)
def test_a_broken_recording_is_refused(there, tmp_path, monkeypatch, name, line):
    monkeypatch.chdir(tmp_path)
    word = BROKEN[name](tmp_path / "recording")
    assert_refused_last(trackwright(*line.format(tmp_path / "recording", **there).split()), word)
    assert not (tmp_path / "out").exists()


ONE_LINE = ("[6.0, 5.0, 0.4]", "[3.0, 0.01, 0.4]"), ("[0.0, 5.0, 2.9]", "[9.0, 0.0, 2.9]")
ONE_PLACE = tuple((place, "[0.0, 0.0, 0.3]") for place in ("[6.0, 0.0, 2.6]", "[6.0, 5.0, 0.4]", "[0.0, 5.0, 2.9]"))


def _places(changes):
    def changed(folder):
        rig = (folder / "rig.toml").read_text()
        for old, new in changes:
            assert old in rig
            rig = rig.replace(old, new)
        (folder / "rig.toml").write_text(rig)
        return ""

    return then(changed)


def _ranges(change):
    return with_table("ranges", change)


METRES = pl.col("range_m")
UNUSABLE = [
    (_ranges(lambda t: t.filter(pl.col("anchor").is_in(["A1", "A2"]))), "at least 3 anchors"),
    (_ranges(lambda t: t.filter((pl.col("anchor") != "A4") & (pl.col("tag") == "T2"))), "4 where rig.toml gives it no"),
    (_places(ONE_LINE), "on one line"),
    (_places(ONE_PLACE), "at one place"),
    (_ranges(lambda t: t.with_columns(range_m=-METRES)), "found 0 at most"),
    (_ranges(lambda t: t.with_columns(range_m=1000.0 * METRES)), "millimetres?"),
    (_ranges(lambda t: t.with_columns(range_m=pl.lit(None, pl.Float64))), "found 0 at most"),
    (_ranges(lambda t: t.head(1)), "found 1 at most"),
]


@pytest.mark.parametrize(
    ("build", "word", "tracker"), [(*x, y) for x, y in zip(UNUSABLE, cycle(("uwb", "multilateration")))]
)
def test_ranges_that_a_tracker_cannot_use_are_refused_even_by_force(tmp_path, build, word, tracker):
    build(tmp_path / "recording")
    said = trackwright("track", tmp_path / "recording", "--tracker", tracker, "--force", "--out", tmp_path / "out")
    assert_refused_last(said, str(tmp_path / "recording"), f"tracker '{tracker}' needs", word)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_errors_of_the_check_stop_whatever_is_computed_from_a_recording(tmp_path):
    for name, changed in (("feet", METRES / 0.3048), ("millimetres", 1000.0 * METRES)):
        _ranges(lambda t, changed=changed: t.with_columns(range_m=changed))(tmp_path / name)
    out = tmp_path / "out"
    for words in (
        ("track", tmp_path / "feet", "--out", out),
        ("tune", tmp_path / "feet", "--out", out),
        ("calibrate", tmp_path / "feet", "--out", out / "c.toml"),
        ("survey", tmp_path / "millimetres", "--out", out / "rig.toml"),
    ):
        said = trackwright(*words)
        assert_refused_last(said, f"{words[1]}: ranges: ")
        assert ("; --force takes it as it is" in said.err) == (words[0] != "tune")
    assert not [*out.glob("*")]


LEVEL = '[tunables."motion.sigma_a"]\nvalue = '
NOISE_FILES = [
    ("", "tunables is missing"),
    ("[tunables", "is not valid TOML"),
    (LEVEL + "nan\n", "motion.sigma_a.value = nan"),
    (LEVEL + "[1.0, [2.0]]\n", "motion.sigma_a.value = [1.0, [2.0]]"),
    (LEVEL + "-0.3\n", "is positive and finite, found -0.3"),
    (LEVEL + '3e2\nunit = "mm/s^2"\n', "unit 'mm/s^2', expected 'rad/s^2'"),
    ('[tunables."motion.sigma_q"]\nvalue = 0.3\n', "this tracker has no 'motion.sigma_q'"),
    ('[tunables."sensors.*.offsets"]\nvalue = [0.1, 0.2]\n', "has shape (2,)"),
]


@pytest.mark.parametrize(
    ("content", "word", "command"), [(*x, y) for x, y in zip(NOISE_FILES, cycle(("track", "tune")))]
)
def test_a_noise_file_that_does_not_fit_is_refused(tmp_path, simulated, content, word, command):
    file = tmp_path / "tuned.toml"
    file.write_text(content)
    said = trackwright(command, simulated, "--tracker", "beam", "--noise", file, "--out", tmp_path / "out")
    assert_refused_last(said, str(file), word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("broken", [b"no archive", None])
def test_a_checkpoint_of_something_else_is_refused_and_kept(tmp_path, simulated, broken):
    if broken is None:
        save(tmp_path, [np.zeros(2)], "another fit")
    else:
        (tmp_path / "checkpoint.npz").write_bytes(broken)
    before = (tmp_path / "checkpoint.npz").read_bytes()
    said = trackwright("tune", simulated, "--tracker", "beam", "--resume", *PLAIN, "--out", tmp_path)
    assert_refused_last(said, "checkpoint.npz", "anew")
    assert (tmp_path / "checkpoint.npz").read_bytes() == before
