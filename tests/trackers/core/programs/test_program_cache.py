"""Compiled programs in a directory: compiled once, damage and refusal cost a line at most, and never a wrong number."""

from __future__ import annotations

import errno
import os
import platform
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.trackers.core import programs
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.jax_private import cache_opener, set_cache_opener
from trackwright.trackers.core.programs import ProgramStore, cache_programs, default_directory, remove_oldest

X = np.linspace(0.0, 1.0, 7)


@pytest.fixture(autouse=True)
def _without_a_cache():
    """jax without a cache, and with that of the suite again after the test."""
    opener, before = cache_opener(), jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    set_cache_opener(opener)
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    set_cache_opener(opener)


@pytest.fixture
def found(monkeypatch):
    """Whether each program that jax looked up was there."""
    looked_up, get = [], ProgramStore.get

    def spy(self, key):
        program = get(self, key)
        looked_up.append(program is not None)
        return program

    monkeypatch.setattr(ProgramStore, "get", spy)
    return looked_up


def _computed():
    """The numbers of a program that jax takes for a new one each time."""
    return np.asarray(jax.jit(lambda x: jnp.cumsum(jnp.sin(x) * x))(X))


def _entries(folder):
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def test_a_program_is_compiled_once_and_gives_the_same_bits(tmp_path, found):
    without = _computed()
    folder = cache_programs(tmp_path / "mine")
    first, second = _computed(), _computed()
    assert found == [False, True]
    assert without.tobytes() == first.tobytes() == second.tobytes()
    assert len(_entries(folder)) == 1
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-9], lambda b: b"junk", lambda b: b"", lambda b: b[:40] + b"x" + b[41:]]
)
def test_a_damaged_program_is_compiled_again_and_replaced(tmp_path, found, damage):
    folder = cache_programs(tmp_path, report=pytest.fail)
    right = _computed()
    (entry,) = _entries(folder)
    entry.write_bytes(damage(entry.read_bytes()))
    (folder / "junk").write_bytes(b"\0" * 99)
    (folder / "folder").mkdir()
    assert _computed().tobytes() == _computed().tobytes() == right.tobytes()
    assert found == [False, False, True]


@pytest.mark.parametrize(("module", "name"), [(programs, "processor"), (platform, "python_version")])
def test_a_program_of_another_version_or_processor_is_not_looked_at(module, name, tmp_path, found, monkeypatch):
    cache_programs(tmp_path)
    _computed()
    monkeypatch.setattr(module, name, lambda: "another")
    cache_programs(tmp_path)
    _computed()
    assert found == [False, False]
    assert len(list(tmp_path.glob("jaxlib-*"))) == 2


def test_a_program_that_cannot_be_written_costs_one_line(tmp_path, monkeypatch):
    lines = []
    cache_programs(tmp_path, report=lines.append)
    right = _computed()

    def full(self, content):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    jax.jit(lambda x: jnp.cos(x))(X)
    jax.jit(lambda x: jnp.tan(x))(X)
    assert _computed().tobytes() == right.tobytes()
    assert len(lines) == 1
    assert "No space left on device" in lines[0]
    assert "\n" not in lines[0]


def _mounted(*arguments):
    """Mounts a file system, which root alone may, or skips the test."""
    if subprocess.run(["mount", *arguments], capture_output=True).returncode:
        pytest.skip("a file system can be mounted by root alone")


def test_programs_of_a_read_only_directory_are_used(tmp_path, found):
    folder = cache_programs(tmp_path)
    right, lines = _computed(), []
    cache_programs(tmp_path / "other")
    if os.geteuid() == 0:  # who may write to any folder
        _mounted("--bind", folder, folder)
        _mounted("-o", "remount,bind,ro", folder)
    else:
        folder.chmod(0o500)
    try:
        cache_programs(tmp_path, report=lines.append)
        assert _computed().tobytes() == right.tobytes()
        jax.jit(lambda x: jnp.cos(x))(X)
        assert found == [False, True, False]
        assert len(lines) == 1
    finally:
        subprocess.run(["umount", folder], check=True) if os.geteuid() == 0 else folder.chmod(0o700)


@pytest.mark.skipif(os.name != "posix", reason="modes and users of POSIX")
def test_a_directory_of_others_is_refused_since_programs_run_as_code(tmp_path, monkeypatch):
    tmp_path.chmod(0o770)
    with pytest.raises(UnusableInput, match="others can write"):
        cache_programs(tmp_path)
    tmp_path.chmod(0o700)
    uid = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: uid + 1)
    with pytest.raises(UnusableInput, match="belongs to user"):
        cache_programs(tmp_path)
    assert jax.config.jax_compilation_cache_dir is None


def test_the_least_recently_used_programs_go_first_and_other_files_stay(tmp_path):
    for number, folder in enumerate(("jaxlib-1-a", "jaxlib-2-b")):
        (tmp_path / folder).mkdir()
        for k in range(5):
            path = tmp_path / folder / f"program-{k}"
            path.write_bytes(bytes(100))
            os.utime(path, (10 * k + number, 10 * k + number))
    (tmp_path / "notes.txt").write_bytes(bytes(5000))
    remove_oldest(tmp_path, limit=1000)
    assert len([*tmp_path.glob("jaxlib-*/*")]) == 10
    remove_oldest(tmp_path, limit=500)
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.glob("jaxlib-*/*"))
    assert left == ["jaxlib-1-a/program-3", "jaxlib-1-a/program-4", "jaxlib-2-b/program-3", "jaxlib-2-b/program-4"]
    assert (tmp_path / "notes.txt").exists()


def test_the_environment_names_the_directory_or_switches_it_off(tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKWRIGHT_CACHE", str(tmp_path / "named"))
    assert cache_programs().parent == tmp_path / "named"
    monkeypatch.setenv("TRACKWRIGHT_CACHE", "off")
    assert cache_programs() is None
    monkeypatch.delenv("TRACKWRIGHT_CACHE")
    monkeypatch.setenv("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", str(tmp_path))
    assert default_directory().name == "trackwright"


def test_a_cache_that_the_user_gave_jax_stays(tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "own"))
    assert cache_programs(tmp_path / "ours") is None
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")
