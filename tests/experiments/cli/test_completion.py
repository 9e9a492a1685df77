"""The completion of a shell has every command and option, is installed by one, and bash uses it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.in_process import trackwright
from trackwright.experiments.cli.commands import application


@pytest.fixture(scope="module")
def script():
    """The completion of bash."""
    return application().generate_completion(shell="bash")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("trackwright tra", {"track", "trackers"}),
        ("trackwright simulate li", {"line"}),
        ("trackwright tune x --held", {"--held-out"}),
        ("trackwright track x --figures p", {"page", "pdf", "png"}),
        ("trackwright track x --tracker multi", {"multilateration"}),
    ],
)
def test_bash_completes(script, line, expected, tmp_path):
    program = tmp_path / "trackwright"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m trackwright "$@"\n')
    program.chmod(0o755)
    words = line.split(" ")
    script += (
        f"\nCOMP_WORDS=({' '.join(repr(word) for word in words)}); COMP_CWORD={len(words) - 1}\n"
        '_trackwright; printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    root = Path(__file__).parents[3]
    done = subprocess.run(
        ["bash", "-c", script], env={**os.environ, "PATH": path}, cwd=root, capture_output=True, text=True, check=True
    )
    assert {word.strip() for word in done.stdout.split()} == expected


def test_it_is_installed_into_the_home_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    said = trackwright("--install-completion", "--shell", "bash")
    assert said.code == 0, said
    (installed,) = (path for path in tmp_path.rglob("trackwright") if path.is_file())
    assert "--held-out" in installed.read_text()
    assert str(installed) in (tmp_path / ".bashrc").read_text()
