"""Pages show the texts of files and never run them."""

from __future__ import annotations

import re
from pathlib import Path

import polars as pl
import pytest

from tests.faulty import RIG, good_tables
from tests.in_process import trackwright

MARKUP = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"  # text that a page has to escape


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


FIT = ("tune", "--tracker", "fix-kf", "--steps", 2, "--starts", 1, "--out", "fit")


@pytest.mark.parametrize(
    ("command", "least"),
    [
        (("track", "--tracker", "fix-kf", "--out", "out"), 1),
        pytest.param(FIT, 1, marks=pytest.mark.slow),
        pytest.param(("calibrate", "--out", "calibration.toml"), 1, marks=pytest.mark.slow),
    ],
)
def test_pages_escape_every_name(marked, tmp_path, monkeypatch, command, least):
    monkeypatch.chdir(tmp_path)
    said = trackwright(command[0], marked, *command[1:])
    assert said.code == 0, said
    pages = [*tmp_path.rglob("*.html")]
    assert len(pages) >= least
    for page in pages:
        text = page.read_text()
        assert MARKUP not in text
        assert "<img src=x" not in text
        assert "alert(1)" in text, f"{page} does not show the names at all"
        own = re.sub(r"<script(?: [^>]*)?>.*?</script>", "", text, flags=re.DOTALL)
        assert not re.search(r"""(?:src|href|action)\s*=\s*["']?\s*(?:https?:|//)|@import|url\(\s*["']?http""", own)
