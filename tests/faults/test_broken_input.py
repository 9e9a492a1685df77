"""A few random cases of each kind; `python -m tests.faults` tries thousands."""

from __future__ import annotations

import pytest

from tests.faults.cases import CASES
from tests.faults.judged import faults_of
from tests.faults.recordings import broken_recording

COUNTS = {"check": 20, "toml": 5, "stores": 3, "import": 10}


def _failed(kind, seed, count, parent):
    """The failing ones of the first cases of a kind: the words that repeat each, and its failure."""
    failed = []
    for number in range(count):
        place = parent / str(number)
        place.mkdir()
        words, wrong, _ = CASES[kind](seed, number, place)
        if wrong:
            failed.append(f"--seed {seed} --first {number} --count 1: {words}: {wrong}")
    return failed


@pytest.mark.parametrize("kind", COUNTS)
def test_broken_input_is_refused_in_a_line_or_read(tmp_path, kind):
    assert not _failed(kind, 1, COUNTS[kind], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "count"), [("check", 2000), ("track", 150), ("tune", 40), ("toml", 200), ("stores", 200), ("import", 1000)]
)
def test_much_broken_input_is_refused_in_a_line_or_read(tmp_path, kind, count):
    assert not _failed(kind, 2, count, tmp_path)


def test_the_same_seed_and_number_give_the_same_recording(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for number in range(20):
        one, words = broken_recording(5, number, tmp_path / "a")
        other, again = broken_recording(5, number, tmp_path / "b")
        assert words == again
        assert {p.name for p in one.iterdir()} == {p.name for p in other.iterdir()}
        one.rename(tmp_path / "a" / f"done-{number}")
        other.rename(tmp_path / "b" / f"done-{number}")


def test_a_traceback_is_a_failure(tmp_path, monkeypatch):
    from trackwright.trackers.recordings import folder as reader

    def broken(path):
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(reader, "read_recording", broken)
    folder, _ = broken_recording(0, 0, tmp_path)
    wrong, _ = faults_of(("check", folder), folder)
    assert wrong.startswith("ZeroDivisionError: a bug")


def test_a_changed_input_is_a_failure(tmp_path, monkeypatch):
    from trackwright.trackers.core.errors import UnusableInput
    from trackwright.trackers.recordings import folder as reader

    def spoils(path):
        (path / "new").touch()
        raise UnusableInput("no")

    monkeypatch.setattr(reader, "read_recording", spoils)
    folder, _ = broken_recording(0, 0, tmp_path)
    assert "changed" in faults_of(("check", folder), folder)[0]
