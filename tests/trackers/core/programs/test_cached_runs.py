"""Whole commands with a cache of compiled programs: the same bits as without, however many run at once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

AT_ONCE = 20


def _started(*words, cache=None) -> subprocess.Popen:
    """A command begun in a process of its own, with a cache directory of its own."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    environment["TRACKWRIGHT_CACHE"] = str(cache)
    command = [sys.executable, "-m", "trackwright", *map(str, words)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _tracks(process: subprocess.Popen, out: Path) -> bytes:
    """The tracks that a command wrote; it must have succeeded without a word about programs."""
    _, err = process.communicate()
    assert process.returncode == 0, err
    assert "program" not in err
    return (out / "tracks.parquet").read_bytes()


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    out = tmp_path_factory.mktemp("cached") / "world"
    process = _started("simulate", "ranges", "--n", 2, "--rows", 40, "--out", out, cache="off")
    _, err = process.communicate()
    assert process.returncode == 0, err
    return out


@pytest.mark.slow
def test_twenty_runs_at_once_on_an_empty_cache_give_the_bits_of_a_run_without(world, tmp_path):
    cache, outs = tmp_path / "cache", [tmp_path / str(k) for k in range(AT_ONCE)]
    running = [_started("track", world, "--out", out, cache=cache) for out in outs]
    written = [_tracks(*pair) for pair in zip(running, outs, strict=True)]
    after = _tracks(_started("track", world, "--out", tmp_path / "after", cache=cache), tmp_path / "after")
    alone = _started("track", world, "--out", tmp_path / "alone", cache="off")
    assert {*written, after} == {_tracks(alone, tmp_path / "alone")}
    assert not [path for path in cache.glob("*/*") if path.name.startswith(".")]
