"""Pages show the texts of files and never run them."""

from __future__ import annotations

import re
from pathlib import Path

import polars as pl
import pytest

from tests.faulty import RIG, good_tables
from tests.in_process import trackwright

MARKUP = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
"""Text that a page has to escape."""


def _named(name: str) -> str:
    return f'"{name}{MARKUP}"'


@pytest.fixture(scope="module")
def marked(tmp_path_factory) -> Path:
    """A recording whose name, anchors, stations and tags are markup."""
    folder = tmp_path_factory.mktemp("marked") / "recording"
    folder.mkdir()
    rig = RIG.replace('name = "good"', f"name = {_named('hall')}").replace('"Made for tests."', _named("about"))
    for old in ("A1", "A2", "A3", "A4"):
        rig = rig.replace(f'"{old}"', _named(old))
    for old in ("stations.S1", "stations.S2", "tags.T1"):
        group, _, name = old.partition(".")
        rig = rig.replace(f"[{old}]", f"[{group}.{_named(name)}]")
    (folder / "rig.toml").write_text(rig.replace("[tags.T2]\noffset_m = [0.1, 0.0, 0.0]\n", ""))
    for name in ("fixes", "truth", "ranges"):
        table = good_tables()[name].filter(pl.col("tag") == "T1")
        table.with_columns(pl.col(c) + MARKUP for c in ("tag", "anchor") if c in table.columns).write_csv(
            folder / f"{name}.csv"
        )
    return folder


def _check_pages(folder: Path, least: int) -> None:
    pages = [*folder.rglob("*.html")]
    assert len(pages) >= least
    for page in pages:
        text = page.read_text()
        assert MARKUP not in text
        assert "<img src=x" not in text
        assert "alert(1)" in text, f"{page} does not show the names at all"
        own = re.sub(r"<script(?: [^>]*)?>.*?</script>", "", text, flags=re.DOTALL)
        assert not re.search(
            r"""(?:src|href|action|poster)\s*=\s*["']?\s*(?:https?:|//)|@import|url\(\s*["']?http""", own
        )


def test_pages_of_tracks_escape_every_name(marked, tmp_path):
    for tracker in ("fix-kf", "median"):
        said = trackwright("track", marked, "--tracker", tracker, "--out", tmp_path / "out" / tracker)
        assert said.code == 0, said
        _check_pages(tmp_path / "out" / tracker, 1)
    runs = (tmp_path / "out" / tracker for tracker in ("fix-kf", "median"))
    assert trackwright("evaluate", *runs, "--out", tmp_path / "compared").code == 0
    _check_pages(tmp_path / "compared", 1)


@pytest.mark.slow
def test_pages_of_a_fit_and_a_calibration_escape_every_name(marked, tmp_path):
    few = ("--steps", 2, "--starts", 1)
    said = trackwright("tune", marked, "--tracker", "fix-kf", *few, "--out", tmp_path / "fit")
    assert said.code == 0, said
    _check_pages(tmp_path / "fit", 1)
    said = trackwright("calibrate", marked, "--out", tmp_path / "calibrated" / "calibration.toml")
    assert said.code == 0, said
    _check_pages(tmp_path / "calibrated", 1)


def test_a_study_whose_name_is_markup_has_an_escaped_page_or_is_refused(tmp_path):
    text = 'name = "x"\nabout = ABOUT\nruns = 2\nmetrics = ["rmse_m"]\n[worlds.line]\nrate_hz = 1.0\n[trackers.ID]\ntracker = "fix-kf"\n'
    (tmp_path / "study.toml").write_text(text.replace("ABOUT", _named("about")).replace("ID", _named("kalman")))
    said = trackwright("study", tmp_path / "study.toml", "--out", tmp_path / "out")
    assert said.code == 0, said
    _check_pages(tmp_path / "out", 1)
