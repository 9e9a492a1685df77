"""`trackwright survey`: the rig, the page and the JSON that it writes, and what it refuses."""

import json
import re

import numpy as np
import pytest

from tests.in_process import assert_refused, trackwright
from tests.survey_sites import simulated_site
from trackwright.experiments.text import terminal
from trackwright.trackers.recordings.folder import write_recording
from trackwright.trackers.recordings.rig_file import read_rig


@pytest.fixture(scope="module")
def walks(tmp_path_factory):
    """Walks at two heights among anchors without positions, and the true distance of the first two anchors, m."""
    there = tmp_path_factory.mktemp("walks")
    folders, anchors, _ = simulated_site(2, (0.5, 1.9), 0.0)
    for folder, name in zip(folders, ("low", "high"), strict=True):
        write_recording(folder, there / name)
    return there / "low", there / "high", np.linalg.norm((anchors[1] - anchors[0])[:2])


def test_walks_without_positions_of_anchors_give_a_rig_and_a_page(walks, tmp_path, monkeypatch):
    *folders, distance = walks
    out = tmp_path / "site" / "rig.toml"
    monkeypatch.setattr(terminal, "FIRST_LINE", 0.1)
    said = trackwright("survey", *folders, "--out", out, "--json")
    assert said.code == 0, said.err
    assert "survey: fitting positions and paths, " in said.err
    assert not re.search(r"\.\d{5}|-0\.0\b", out.read_text("utf-8"))
    anchors = read_rig(out)[0].anchors
    assert abs(anchors["A01"][0] - distance) < 0.2
    assert anchors["A01"][1] == pytest.approx(0.0, abs=1e-9)
    found = json.loads(said.out)["anchors"]
    assert found["A01"]["half_width_m"][1] == 0.0
    assert found["A03"]["half_width_m"][0] > 0.0
    assert {path.name for path in out.parent.iterdir()} == {"rig.toml", "rig.html"}
    assert "determined" in out.with_suffix(".html").read_text("utf-8")
    assert_refused(trackwright("survey", *folders, "--out", out), "exists", "--force")
    assert_refused(trackwright("survey", *folders, "--out", folders[0] / "new.toml"), "is a recording folder")
    again = trackwright("survey", folders[1], "--given", "all", "--sigma", "0.1", "--out", out, "--force")
    assert "is a recording folder" not in again.err  # a folder with a rig.toml alone takes results


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--given", "A00,A01,A02"), "rig.toml has no anchor A00"),
        (("--sigma", "0.1"), "belongs to given positions"),
        (("--sigma", "-1"), "expected metres"),
        (("--frame", "A00,A01"), "expected three different anchors"),
        (("--frame", "A00,A01,A01"), "expected three different anchors"),
        (("--frame", "A00,A01,A02", "--given", "all"), "leave one out"),
        (("--frame", "A00,A01,B"), "'B' has no readings"),
        (("--height", "nan"), "expected metres"),
        (("--height", "1e9"), "expected metres"),
    ],
)
def test_options_without_sense_are_refused_in_one_line(walks, tmp_path, options, word):
    assert_refused(trackwright("survey", *walks[:2], *options, "--out", tmp_path / "rig.toml"), word)
    assert not list(tmp_path.iterdir())
