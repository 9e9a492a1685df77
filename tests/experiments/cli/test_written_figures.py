"""Which figures and pages `tune`, `study` and `evaluate` of several runs write."""

from __future__ import annotations

import dataclasses
import re

import pytest

from tests.experiments.monte_carlo.small_study import TOML
from tests.in_process import trackwright
from trackwright.sim import worlds
from trackwright.trackers.recordings.folder import write_recording

MAGIC = {".png": b"\x89PNG\r\n", ".pdf": b"%PDF-"}
FIT = ("--tracker", "fix-kf", "--tune", "motion.sigma_a", "--steps", 1, "--starts", 1)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """Two recordings of the position fixes of a vehicle, 60 each."""
    paths = [tmp_path_factory.mktemp("figures") / name for name in ("room", "other")]
    for seed, path in enumerate(paths):
        folder = worlds.agv(n=1, seed=seed, rows=60).folder()
        rig = dataclasses.replace(folder.rig, name=path.name)
        write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
    return paths


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "left"),
    [
        ((), {"report.html"}),
        (("--figures", "png"), {"report.html", "tuning.png"}),
        (("--figures", "pdf"), {"report.html", "tuning.pdf"}),
    ],
)
def test_tune_writes_the_figures_and_the_page_that_are_asked_for(rooms, tmp_path, options, left):
    done = trackwright("tune", rooms[0], "--held-out", rooms[1], *FIT, *options, "--out", tmp_path)
    assert done.code == 0, done
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"tuned.toml", "trace.csv", "manifest.json", "checkpoint.npz"} | left
    assert set(re.findall(r"[\w.-]+\.(?:html|png|pdf)", done.out.splitlines()[-1])) == left
    _assert_kinds(tmp_path)


@pytest.mark.parametrize(
    ("options", "figures", "report"),
    [
        ((), set(), True),
        (("--figures", "pdf"), {"rmse_m.pdf"}, True),
        (("--figures", "none"), set(), False),
    ],
)
def test_study_writes_the_figures_and_the_page_that_are_asked_for(tmp_path, options, figures, report):
    (tmp_path / "small.toml").write_text(TOML.replace("runs = 12", "runs = 4"), "utf-8")
    out = tmp_path / "out"
    done = trackwright("study", tmp_path / "small.toml", *options, "--out", out)
    assert done.code == 0, done
    files = {"study.json", "results.json", "manifest.json"} | ({"report.html"} if report else set())
    assert {path.name for path in out.iterdir() if path.is_file()} == files | figures
    assert set(re.findall(r"[\w-]+\.(?:png|pdf)", done.out)) == figures
    assert ("report.html" in done.out) == report
    _assert_kinds(out)


def _assert_kinds(folder):
    """The figures of a folder are what their endings say."""
    for path in folder.iterdir():
        if path.suffix in MAGIC:
            assert path.read_bytes().startswith(MAGIC[path.suffix]), path
