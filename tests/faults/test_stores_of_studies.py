"""A study's folder after faults: truncated and damaged chunks, another clock, a folder that takes no files, two callers."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.experiments.monte_carlo.small_study import TOML
from trackwright.experiments.monte_carlo.chunk_store import ChunkStore
from trackwright.experiments.monte_carlo.runner import run_study
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.experiments.pages.reports.study_text import to_json
from trackwright.trackers.core.errors import UnusableInput


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    file = tmp_path_factory.mktemp("study") / "small.toml"
    file.write_text(TOML + "[grid]\n'world.speed' = [0.2, 0.3, 0.4]\n")
    return load_study(str(file))


def _sha(study, folder: Path) -> str:
    results = run_study(study, folder)
    assert results is not None
    assert not [path.name for path in folder.rglob(".*")]
    return json.loads(to_json(results, []))["sha256"]


@pytest.fixture(scope="module")
def whole(study, tmp_path_factory):
    return _sha(study, tmp_path_factory.mktemp("whole") / "out")


def _chunks(folder: Path) -> list[Path]:
    return sorted((folder / "chunks").glob("*.npz"))


@pytest.mark.parametrize("kept", [0, 1, 0.5, 0.99])
def test_a_truncated_chunk_is_computed_again_to_the_same_bits(study, whole, tmp_path, kept):
    _sha(study, tmp_path)
    path = _chunks(tmp_path)[1]
    before = path.read_bytes()
    path.write_bytes(before[: int(kept * len(before)) if kept != 1 else 1])
    others = {one: one.stat().st_mtime_ns for one in _chunks(tmp_path) if one != path}
    assert _sha(study, tmp_path) == whole
    assert len(path.read_bytes()) > 0.9 * len(before)
    assert {one: one.stat().st_mtime_ns for one in others} == others


def test_a_damaged_chunk_is_named(study, tmp_path):
    _sha(study, tmp_path)
    path = _chunks(tmp_path)[1]
    data = bytearray(path.read_bytes())
    data[60] ^= 255
    path.write_bytes(data)
    with pytest.raises(UnusableInput, match=f"{path.name}: not a chunk of a study; remove it"):
        run_study(study, tmp_path)


def test_a_clock_that_is_set_back_or_forth_costs_no_chunk(study, whole, tmp_path, monkeypatch):
    _sha(study, tmp_path)
    for year in (0, 4e9):
        for path in tmp_path.rglob("*"):
            os.utime(path, (year, year))
        monkeypatch.setattr(ChunkStore, "write", None)
        assert _sha(study, tmp_path) == whole
        monkeypatch.undo()


def test_two_callers_on_one_folder_end_with_the_same_bits(study, whole, tmp_path):
    with ThreadPoolExecutor(2) as callers:
        found = [*callers.map(lambda _: run_study(study, tmp_path), range(2))]
    assert [json.loads(to_json(results, []))["sha256"] for results in found] == [whole, whole]
    assert not [path.name for path in tmp_path.rglob(".*")]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to read-only folders")
def test_a_read_only_folder_is_refused(study, tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(UnusableInput, match="--out .* cannot be created"):
            run_study(study, tmp_path / "out")
    finally:
        tmp_path.chmod(0o700)


def test_a_folder_that_takes_no_files_is_refused(study):
    # Not even root may write there.
    with pytest.raises(UnusableInput, match="--out /proc/self/out: cannot be created"):
        run_study(study, Path("/proc/self/out"))
