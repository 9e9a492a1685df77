"""Which figures and pages `tune` and `study` write."""

from __future__ import annotations

import dataclasses
import re

import pytest

from sim import worlds
from tests.experiments.monte_carlo.small_study import TOML
from tests.in_process import trackwright
from trackers.recordings.folder import write_recording

FIT = ("--tracker", "uwb", "--tune", "motion.sigma_a", "--steps", 1, "--starts", 1)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two recordings of a tag among four anchors, 6 s of ranges."""
    paths = [tmp_path_factory.mktemp("figures") / name for name in ("room", "other")]
    for seed, path in enumerate(paths):
        folder = worlds.ranges(n=1, seed=seed, rows=60).folder()
        rig = dataclasses.replace(folder.rig, name=path.name)
        write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
    return paths


@pytest.mark.parametrize(
    ("options", "left"),
    [
        ((), {"report.html", "tuning.png"}),
        (("--no-figures",), {"report.html"}),
        (("--no-report",), {"tuning.png"}),
        (("--no-figures", "--no-report"), set()),
    ],
)
def test_tune_writes_the_figures_and_the_page_that_are_asked_for(rooms, tmp_path, options, left):
    done = trackwright("tune", rooms[0], "--held-out", rooms[1], *FIT, *options, "--out", tmp_path)
    assert done.code == 0, done
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"tuned.toml", "trace.csv", "manifest.json", "checkpoint.npz"} | left
    named = set(re.findall(r"[\w.]+\.(?:html|png)", done.out.splitlines()[-1]))
    assert named == left
    if "report.html" in left:
        page = (tmp_path / "report.html").read_text("utf-8")
        assert re.findall(r'alt="Floor plan of (\w+), tag', page) == ["other", "room"]


@pytest.mark.parametrize("report", [True, False])
def test_study_writes_no_page_that_is_not_wanted(tmp_path, report):
    (tmp_path / "small.toml").write_text(TOML.replace("runs = 12", "runs = 4"), "utf-8")
    options = () if report else ("--no-report", "--no-figures")
    done = trackwright("study", tmp_path / "small.toml", *options, "--out", tmp_path / "out")
    assert done.code == 0, done
    assert (tmp_path / "out" / "report.html").exists() == report
    assert ("report.html" in done.out) == report
    assert (tmp_path / "out" / "results.json").exists()
