"""A study's folder: chunks in any order, shards, damaged chunks, other clocks, two callers, no place to write."""

from __future__ import annotations

import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.experiments.monte_carlo.small_study import SMALL, sha
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.runner import run_missing, run_study
from trackwright.experiments.monte_carlo.store import ChunkStore, packed
from trackwright.trackers.core.errors import UnusableInput


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The folder of a finished study, and the digest of its results."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    return folder, sha(run_study(SMALL, folder))


@pytest.fixture
def finished(whole, tmp_path):
    """A copy of that folder, and its chunks."""
    folder = tmp_path / "out"
    shutil.copytree(whole[0], folder)
    return folder, sorted((folder / "chunks").glob("*.npz"))


def test_chunks_in_another_order_and_in_shards_give_the_same_numbers(whole, tmp_path):
    backwards = ChunkStore(tmp_path / "backwards", SMALL).open()
    for condition in reversed(SMALL.conditions):
        for chunk in reversed(range(SMALL.chunks)):
            run_missing(backwards, [(condition.index, chunk)])
    assert sha(backwards.results({c.index: SMALL.runs for c in SMALL.conditions})) == whole[1]
    shards = tmp_path / "shards"
    assert run_study(SMALL, shards, (1, 2)) is None
    # What a killed process was writing is no chunk.
    (shards / "chunks" / ".trackwright-01234567-0000-000000.npz").write_bytes(b"half")
    assert sha(run_study(SMALL, shards, (2, 2))) == whole[1]


def test_a_chunk_of_another_study_is_computed_again(whole, finished):
    folder, _ = finished
    other = dataclasses.replace(SMALL, seed=1)
    ChunkStore(folder, other).keep((0, 0), packed(run_chunk(other, other.conditions[0], np.arange(6), True)))
    assert sha(run_study(SMALL, folder)) == whole[1]


@pytest.mark.parametrize("kept", [0, 0.99])
def test_a_truncated_chunk_is_computed_again_to_the_same_bits(whole, finished, kept):
    folder, (path, *others) = finished
    before, made = path.read_bytes(), {one: one.stat().st_mtime_ns for one in others}
    path.write_bytes(before[: int(kept * len(before))])
    assert sha(run_study(SMALL, folder)) == whole[1]
    assert len(path.read_bytes()) > 0.9 * len(before)
    assert {one: one.stat().st_mtime_ns for one in others} == made


def test_a_damaged_chunk_is_named(finished):
    folder, (path, *_) = finished
    data = bytearray(path.read_bytes())
    data[60] ^= 255
    path.write_bytes(data)
    with pytest.raises(UnusableInput, match=f"{path.name}: not a chunk of a study; remove it"):
        run_study(SMALL, folder)


@pytest.mark.slow
def test_two_callers_on_one_folder_end_with_the_same_bits(whole, tmp_path):
    with ThreadPoolExecutor(2) as callers:
        found = [*callers.map(lambda _: run_study(SMALL, tmp_path), range(2))]
    assert [*map(sha, found)] == [whole[1]] * 2
    assert not [path.name for path in tmp_path.rglob(".*")]
