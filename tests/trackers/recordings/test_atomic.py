"""Atomic writes, strict JSON, and the manifest of a run."""

import errno
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import jax
import numpy as np
import pytest

from trackwright.experiments.cli.runtime import write_manifest
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import (
    PREFIX,
    atomic_write,
    beside,
    config_hash,
    json_text,
    remove_abandoned,
)


def _half_then(error):
    def write(path):
        path.write_text("half")
        raise error

    return write


def test_a_file_is_written_under_its_name_alone(tmp_path):
    path = atomic_write(tmp_path / "table.csv", lambda p: p.write_text("a,b\n"))
    assert [p.name for p in tmp_path.iterdir()] == ["table.csv"]
    assert path.read_text() == "a,b\n"


def test_a_writer_sees_the_ending_of_the_name(tmp_path):
    seen = []
    atomic_write(tmp_path / "t.csv.gz", lambda p: seen.append(p.name) or p.touch())
    assert seen[0].endswith("t.csv.gz")


def test_a_full_disk_leaves_the_old_file_and_no_partial_one(tmp_path):
    (tmp_path / "out.json").write_text("old")
    with pytest.raises(UnusableInput, match=r"cannot write .*out\.json: No space left on device"):
        atomic_write(tmp_path / "out.json", _half_then(OSError(errno.ENOSPC, "No space left on device")))
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]
    assert (tmp_path / "out.json").read_text() == "old"


@pytest.mark.parametrize("error", [ValueError("a bug"), KeyboardInterrupt()])
def test_any_other_failure_is_raised_and_leaves_no_partial_file(tmp_path, error):
    with pytest.raises(type(error)):
        atomic_write(tmp_path / "out.json", _half_then(error))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["nowhere/out.json", "file/out.json"])
def test_a_path_in_a_missing_folder_is_refused(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(UnusableInput, match="cannot write"):
        atomic_write(tmp_path / name, lambda p: p.write_text("x"))


def test_a_folder_of_the_same_name_is_refused(tmp_path):
    (tmp_path / "out.json" / "inside").mkdir(parents=True)
    with pytest.raises(UnusableInput, match="cannot write"):
        atomic_write(tmp_path / "out.json", lambda p: p.write_text("x"))
    assert [p.name for p in tmp_path.iterdir()] == ["out.json"]


def test_json_is_strict_and_takes_arrays():
    value = {"a": np.float32(0.5), "b": np.arange(2), "c": math.nan, "d": Path("x"), 3: (math.inf, True, None, "é")}
    parsed = json.loads(json_text(value), parse_constant=pytest.fail)
    assert parsed == {"a": 0.5, "b": [0, 1], "c": None, "d": "x", "3": [None, True, None, "é"]}


def test_json_takes_arrays_of_jax():
    assert json.loads(json_text({"a": jax.numpy.ones(2)})) == {"a": [1.0, 1.0]}


def test_the_manifest_records_command_versions_and_device(tmp_path):
    config = {"sigma_a": np.float32(0.5), "recordings": [Path("hall")]}
    started = datetime(2024, 5, 1, 12, 0, tzinfo=UTC)
    path = write_manifest(
        tmp_path, ["trackwright", "track"], config, started, [1, 2], 256, {"files": ["tracks.parquet"]}
    )
    manifest = json.loads(path.read_text())
    assert manifest["command"] == ["trackwright", "track"]
    assert manifest["config"] == {"sigma_a": 0.5, "recordings": ["hall"]}
    assert manifest["config_sha256"] == config_hash(config)
    assert (manifest["seeds"], manifest["chunk"], manifest["files"]) == ([1, 2], 256, ["tracks.parquet"])
    assert manifest["versions"]["jax"] == jax.__version__
    assert set(manifest["versions"]) == {"trackwright", "jax", "jaxlib", "numpy", "python"}
    assert manifest["n_devices"] == jax.device_count()
    assert datetime.fromisoformat(manifest["started"]) == started < datetime.fromisoformat(manifest["ended"])


def test_the_hash_of_a_configuration_depends_on_its_values_and_not_on_their_order():
    first, second = config_hash({"a": 1, "b": {"c": 2.0, "d": 3}}), config_hash({"b": {"d": 3, "c": 2.0}, "a": 1})
    assert first == second
    assert first != config_hash({"a": 1, "b": {"c": 2.0, "d": 4}})


def test_a_file_that_is_taken_for_abandoned_before_it_is_locked_is_made_again(tmp_path):
    pytest.importorskip("fcntl")
    taken = []

    def make(path):
        path.touch()
        if not taken:
            taken.append(path)
            remove_abandoned(tmp_path)
            assert not path.exists()

    with beside(tmp_path / "a", make) as path:
        assert path.exists()
        remove_abandoned(tmp_path)
        assert path.exists()
    assert taken
    assert not [*tmp_path.iterdir()]


def test_files_of_others_are_not_taken_for_abandoned(tmp_path):
    (tmp_path / ".hidden").touch()
    (tmp_path / "target").touch()
    (tmp_path / f"{PREFIX}link").symlink_to(tmp_path / "target")
    remove_abandoned(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".hidden", f"{PREFIX}link", "target"]
