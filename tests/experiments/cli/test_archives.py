"""`track` and `evaluate` on an archive: one table of results, faults cost their own line, the next run continues."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import polars as pl
import pytest

from tests.experiments.cli.small_archive import recording, write_archive
from tests.experiments.jobs.deadly import Deadly
from tests.in_process import PLAIN, assert_refused, assert_refused_last, trackwright
from trackwright.experiments.cli import archive as command
from trackwright.experiments.cli import tracking
from trackwright.experiments.jobs.executors import environment
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.folder import MANY, archive_of, read_recording, write_recording

COUNT = 16
BROKEN, FAILING = (3, 11, 12), 14
"""Numbers of the recordings that cannot be read, and of the one that fails while it is tracked."""

TABLES = ("tracks.parquet", "evaluation.json", "results.csv", "recordings.txt")


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Recordings in three folders; three of them are broken, each in its own way."""
    folder = tmp_path_factory.mktemp("archive")
    paths = write_archive(folder, COUNT)
    (paths[3] / "rig.toml").unlink()
    (paths[11] / "rig.toml").write_bytes(bytes(range(256)))
    table = (paths[12] / "fixes.parquet").read_bytes()
    (paths[12] / "fixes.parquet").write_bytes(table[: len(table) // 2])
    return folder


@pytest.fixture(scope="module", autouse=True)
def begun():
    """The names of the recordings that are tracked; the one with the number `FAILING` fails."""
    names, with_truth = [], tracking.with_truth

    def failing(tracks, folders):
        names.append(tracks["recording"][0])
        if names[-1] == f"walk-{FAILING}":
            raise MemoryError("no memory is left")
        return with_truth(tracks, folders)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracking, "with_truth", failing)
        yield names


@pytest.fixture(scope="module")
def whole(archive, begun, tmp_path_factory):
    """A run that nothing interrupts, and its output folder."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return trackwright("track", archive, *PLAIN, "--out", out), out


def _bytes(out):
    return {name: (out / name).read_bytes() for name in TABLES}


def _results(out):
    return pl.read_csv(out / "results.csv")


def test_folders_of_folders_many_recordings_and_a_cluster_make_an_archive(tmp_path):
    for name in ("a/rig.toml", "a/old/rig.toml", "b/deep/ranges.csv.gz", "b/notes.csv", ".c/rig.toml", "d/x.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "b" / "loop").symlink_to(tmp_path)
    found = [tmp_path / "a", tmp_path / "b" / "deep"]
    many = [tmp_path / f"r{k}" for k in range(MANY + 1)]
    for paths, always, expected in (
        ([tmp_path], False, found), (found, False, None), (found, True, found), ([tmp_path / "d"], False, None),
        (many[1:], False, None), (many, False, many),
    ):  # fmt: skip
        assert archive_of(paths, always) == expected
    with pytest.raises(UnusableInput, match="more than once"):
        archive_of([tmp_path, tmp_path / "a"], False)


def test_a_broken_folder_costs_its_own_line_and_never_the_rest(archive, whole):
    done, out = whole
    assert done.code == 3, done.err
    results = _results(out)
    assert len(results) == COUNT
    refused = results.filter(pl.col("refused").is_not_null())
    named = [*BROKEN, FAILING]
    assert refused["path"].to_list() == [str(archive / f"day-{k // 10}" / f"walk-{k:02d}") for k in named]
    listed = [line for line in done.err.splitlines() if line.startswith("not tracked: ")]
    assert f"4 of {COUNT} recordings not tracked; notices: see {out / 'results.csv'}" in done.err
    assert listed == [f"not tracked: {line}" for line in refused["refused"]]
    for line, word in zip(listed, ("rig.toml", "rig.toml", "fixes.parquet", "MemoryError"), strict=True):
        assert word in line
    ok = results.filter(pl.col("refused").is_null())
    assert set(ok["endings"]) == {"ok 1"}


def test_the_tables_are_those_of_each_recording_alone_and_of_all_rows_at_once(archive, whole):
    _, out = whole
    paths = [path for path in sorted(archive.glob("*/*")) if not path.name.endswith(("03", "11", "12", "14"))]
    folders = [read_recording(path) for path in paths]
    alone = [build("fix-kf", folder).run(folder) for folder in folders]
    tables = pl.concat([one.table for one in alone])
    assert pl.read_parquet(out / "tracks.parquet").equals(tables)
    found = json.loads((out / "evaluation.json").read_text())
    for metrics, pair in zip(found["recordings"], zip(alone, folders, strict=True), strict=True):
        for name, value in evaluate(*pair).recordings[0].items():
            equal = value if value is None or isinstance(value, str) else pytest.approx(value, rel=1e-12)
            assert metrics[name] == equal, name
    expected = evaluate(tables, folders).overall
    for name, value in found["overall"].items():
        if not name.startswith("residual_"):
            assert value == (value if expected[name] is None else pytest.approx(expected[name], rel=1e-12)), name
    (kept,) = (out / "recordings").glob("walk-05-*")
    assert pl.read_parquet(kept / "tracks.parquet").equals(alone[4].table)
    assert trackwright("evaluate", kept).code == 0


def test_the_same_command_continues_after_an_end_at_any_moment(archive, whole, begun, tmp_path, monkeypatch):
    keep, written = command.Archive.keep, []

    def ends(store, item, found):
        if len(written) == 6 and not isinstance(found, str):
            raise KeyboardInterrupt
        written.extend([item] * (not isinstance(found, str)))
        return keep(store, item, found)

    with monkeypatch.context() as patch:
        patch.setattr(command.Archive, "keep", ends)
        assert trackwright("track", archive, *PLAIN, "--out", tmp_path).code == 130
    assert not (tmp_path / "results.csv").exists()
    assert_refused(trackwright("evaluate", tmp_path), "was not tracked to its end")
    del begun[:]
    done = trackwright("track", archive, *PLAIN, "--out", tmp_path)
    assert done.code == 3
    assert not {path.name for path in written} & set(begun)
    assert len(begun) == COUNT - len(BROKEN) - 6
    assert _bytes(tmp_path) == _bytes(whole[1])


@pytest.mark.slow
def test_what_changed_is_tracked_again_and_nothing_else(tmp_path, begun):
    paths, out = write_archive(tmp_path / "archive", 4), tmp_path / "out"

    def tracked_again(*options):
        del begun[:]
        assert trackwright("track", tmp_path / "archive", *PLAIN, *options, "--out", out).code == 0
        return sorted(begun)

    names = [path.name for path in paths]
    assert tracked_again() == names
    assert tracked_again() == []
    (paths[1] / "rig.toml").write_text((paths[1] / "rig.toml").read_text() + '\nabout = "moved"\n')
    assert tracked_again() == ["walk-01"]
    (kept,) = (out / "recordings").glob("walk-02-*/tracks.parquet")
    kept.write_bytes(kept.read_bytes()[:-100])
    (marker,) = (out / "recordings").glob("walk-03-*/tracked.json")
    marker.write_text("{")
    assert tracked_again() == ["walk-02", "walk-03"]
    assert tracked_again("--set", "motion.sigma_a=0.7") == names
    shutil.rmtree(paths[0])
    assert tracked_again("--set", "motion.sigma_a=0.7") == []
    assert set(pl.read_parquet(out / "tracks.parquet")["recording"]) == set(names[1:])


def test_estimates_are_evaluated_again(tmp_path):
    paths, out = write_archive(tmp_path / "archive", 4), tmp_path / "out"
    assert trackwright("track", tmp_path / "archive", *PLAIN, "--out", out).code == 0
    tracked = json.loads((out / "evaluation.json").read_text())
    done = trackwright("evaluate", out, "--json", "--fail-if", "rmse_m > 10")
    assert done.code == 0, done.err
    again = json.loads(done.out)
    for name, value in again["overall"].items():
        if not name.startswith("residual_"):
            assert value == (value if value is None else pytest.approx(tracked["overall"][name], rel=1e-12)), name
    assert_refused(trackwright("evaluate", out, "--fail-if", "rmse > 10"), "no metric 'rmse' (did you mean rmse_m?)")
    failed = trackwright("evaluate", out, "--fail-if", "rmse_m > 0.001")
    assert failed.code == 1
    assert "fails: rmse_m > 0.001 (rmse_m is " in failed.err
    (paths[2] / "truth.parquet").unlink()
    assert trackwright("evaluate", out, "--allow-left-out").code == 0
    done = trackwright("evaluate", out)
    assert done.code == 3
    assert f"not evaluated: {paths[2]}: no truth table" in done.err


def test_an_archive_takes_the_tracker_of_its_first_readable_recording_or_none(tmp_path):
    paths = write_archive(tmp_path / "archive", 3)
    (paths[0] / "rig.toml").write_text("[")
    done = trackwright("track", tmp_path / "archive", "--out", tmp_path / "out")
    assert done.code == 3
    assert "tracker: fix-kf (" in done.err
    none = trackwright("track", tmp_path / "archive", "--tracker", "uwb", "--out", tmp_path / "none")
    assert_refused_last(none, "(2 more recordings: none could be tracked)")


def test_recordings_of_one_name_are_named_by_their_paths_and_runs_of_archives_compared(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for k, name in enumerate(("same", "other", "same", "archive/r0")):
        write_recording(recording(name, k), tmp_path / "archive" / f"r{k}")
    names = ["archive/r0", "other", "archive/r2", "archive/r3"]
    for tracker in ("median", "fix-kf"):
        done = trackwright("track", "archive", "--tracker", tracker, "--out", tracker)
        assert done.code == 0, done.err
        assert "notice: 3 recordings, as archive/r0, named by paths: others have their names" in done.err
        assert _results(tmp_path / tracker)["recording"].to_list() == names
    done = trackwright("evaluate", "fix-kf", "--json")
    found = {one["recording"]: one["rmse_m"] for one in json.loads(done.out)["recordings"]}
    expected = dict(_results(tmp_path / "fix-kf").select("recording", "rmse_m").iter_rows())
    assert found == pytest.approx(expected, rel=1e-12)
    said = trackwright("evaluate", "median", "fix-kf")
    assert said.code == 0, said.err
    assert "Differences from median" in said.out


@contextmanager
def _elsewhere(cluster):
    """Workers as those of a cluster, in threads; one recording ends every worker that tracks it."""
    with ThreadPoolExecutor(2) as threads:
        yield Deadly(threads, environment(), lambda path: path.name == "walk-01")


@pytest.mark.slow
def test_a_cluster_computes_the_same_bits_and_a_recording_that_ends_workers_costs_its_own_line(tmp_path, monkeypatch):
    write_archive(tmp_path / "archive", 4)
    own = "from trackwright.trackers.catalogue import spec_of\n\nMINE = spec_of('fix-kf')\n"
    (tmp_path / "mine.py").write_text(own)
    options = (*PLAIN, "--tracker", f"{tmp_path}/mine.py:MINE", "--lag", 2)
    assert trackwright("track", tmp_path / "archive", *options, "--out", tmp_path / "here").code == 0
    monkeypatch.setattr(command, "cluster_executor", _elsewhere)
    on = ("--cluster", "tcp://elsewhere:8786")
    done = trackwright("track", tmp_path / "archive", *options, "--out", tmp_path / "there", *on)
    assert done.code == 3
    assert "walk-01: cannot be used (KilledWorker" in done.err
    here, there = (pl.read_parquet(tmp_path / name / "tracks.parquet") for name in ("here", "there"))
    assert there.equals(here.filter(pl.col("recording") != "walk-01"))
