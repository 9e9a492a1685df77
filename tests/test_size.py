"""The size of the house: limits that later changes may only lower. `LINES`: of Python, of each folder at the top."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import trackwright as tw
from trackwright.experiments.cli.main import COMMANDS

ROOT = Path(__file__).parents[1]
LINES = {"trackers": 22_435, "sim": 1_926, "tuning": 4_313, "experiments": 9_491, "trackwright": 29, "tests": 23_825}

PRODUCT_LINES, PRODUCT_FILES, WORDS, MOST_COMMANDS, MOST_NAMES = 38_194, 239, 36_872, 13, 94


def _files(*suffixes: str) -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("no git checkout, so that the files of the project are unknown")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name.endswith(suffixes)]
    return [path for path in paths if path.is_file() and not path.is_symlink()]


def _lines(folder: str) -> tuple[int, int]:
    files = [path for path in _files(".py") if path.relative_to(ROOT).parts[0] == folder]
    return sum(path.read_bytes().count(b"\n") for path in files), len(files)


@pytest.mark.parametrize("folder", LINES)
def test_a_folder_has_no_more_lines_of_python_than_its_limit(folder):
    assert _lines(folder)[0] <= LINES[folder]


def test_the_product_is_no_larger_than_its_limits():
    lines, files = (sum(counts) for counts in zip(*(_lines(name) for name in LINES if name != "tests"), strict=True))
    assert lines <= PRODUCT_LINES
    assert files <= PRODUCT_FILES


def test_the_docs_have_no_more_words_than_their_limit():
    pages = [path for path in _files(".md") if path.parent == ROOT / "docs" or path.name == "README.md"]
    assert sum(len(path.read_text(encoding="utf-8").split()) for path in pages) <= WORDS


def test_there_are_no_more_commands_and_names_at_the_top_than_their_limits():
    assert len(COMMANDS) <= MOST_COMMANDS
    assert len(tw.__all__) <= MOST_NAMES
