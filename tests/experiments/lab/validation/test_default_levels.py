"""The command that sets default noise levels: its objective, its levels, and sites judged with those of the others."""

import dataclasses
import json
from typing import ClassVar

import numpy as np
import pytest

from trackwright.experiments.lab.cases import Output
from trackwright.experiments.lab.validation import default_levels as module
from trackwright.experiments.lab.validation import sites
from trackwright.experiments.lab.validation.default_levels import KINDS, Objective, default_levels, shortened
from trackwright.experiments.lab.validation.sites import at_levels
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import associate, evaluate
from trackwright.trackers.evaluation.scoring import covariances
from trackwright.trackers.recordings.folder import read_recording, read_recordings, write_recording

ESTIMATES = ["filtered, errors given", "filtered", "smoothed"]


@pytest.fixture
def root(tmp_path, monkeypatch):
    """Recordings of two sites, of which the present levels have seen one each."""
    for seed, name in enumerate(("hall-1", "hall-2", "shed-1")):
        folder = worlds.ranges(n=1, seed=seed, rows=60).folder()
        rig = dataclasses.replace(folder.rig, name=name)
        write_recording(dataclasses.replace(folder, name=name, rig=rig), tmp_path / name)
    monkeypatch.setenv("TRACKWRIGHT_RECORDINGS", str(tmp_path))
    monkeypatch.setattr(module, "SEEN_BY_DEFAULTS", {"uwb": ("hall-1", "shed-1"), "bearings": ("hall-1", "hall-2")})
    for place in (module, sites):
        monkeypatch.setattr(place, "left_out_file", lambda kind: tmp_path / f"{kind}.toml")
    return tmp_path


@pytest.mark.parametrize("kind", KINDS)
def test_levels_are_keywords_of_the_builder_with_the_present_defaults(kind):
    levels = KINDS[kind]
    values = levels.values()
    assert set(values) == set(levels.names)
    assert all(np.all(np.asarray(value) > 0) for value in values.values())


@pytest.mark.slow
def test_the_objective_is_the_mean_log_density_of_the_true_positions_over_the_floor(recordings):
    folders = read_recordings([recordings / f"ble51-walk-u{k}-r1" for k in (1, 2)])
    objective = Objective(KINDS["bearings"], folders)
    found = objective.by_recording(objective.start())
    for folder in folders:
        pairs = associate(build("bearings", folder).run(folder), folder)
        rows = pairs.rows.filter(pairs.scored)
        errors = (rows.select("x_m", "y_m").to_numpy() - pairs.truth[pairs.scored][:, :2])[:, :, None]
        covs = covariances(rows)[:, :2, :2]
        nees = (errors.mT @ np.linalg.inv(covs) @ errors).ravel()
        expected = np.mean(0.5 * nees + 0.5 * np.log(np.linalg.det(2 * np.pi * covs)))
        assert found[folder.name] == pytest.approx(expected, rel=1e-4)
    assert objective(objective.start()) == pytest.approx(np.mean(list(found.values())))


class _Levels(Objective):
    """An objective that is least at a `bias` that tells which recordings it has seen."""

    fits: ClassVar[list[list[str]]] = []

    def __init__(self, levels, folders):
        self.levels, self.now = levels, levels.values()
        self.fits.append([folder.name for folder in folders])
        self.best = self.start() + np.log(1.0 + len(self.fits))

    def __call__(self, logarithms):
        return float(np.sum((logarithms - self.best) ** 2))


def test_no_recording_is_judged_with_levels_that_a_recording_of_its_site_has_set(root, monkeypatch, capsys):
    judged = {}

    def beside(tracker, folder, ways):
        judged[folder.name] = ways
        yield {"recording": folder.name}

    monkeypatch.setattr(module, "Objective", _Levels)
    monkeypatch.setattr(_Levels, "fits", [])
    monkeypatch.setattr(module, "beside", beside)
    default_levels("uwb", left_out=True, output=Output(out=root / "levels.json"))
    assert _Levels.fits == [["hall-1", "shed-1"], ["shed-1"], ["hall-1"]]
    assert [*judged] == ["hall-1", "hall-2", "shed-1"]
    assert [*judged["hall-1"]] == ["present", "all sites", "other sites"]
    assert judged["hall-2"] == judged["hall-1"]
    assert judged["shed-1"] == judged["hall-1"] | {"other sites": judged["shed-1"]["other sites"]}
    bias = [judged[name][way]["bias"] for name, way in (("hall-1", "all sites"), ("hall-1", "other sites"))]
    assert judged["hall-1"]["present"] == KINDS["uwb"].values()
    assert bias[0] < bias[1] < judged["shed-1"]["other sites"]["bias"]
    assert "site 2 of 2: without shed\n" in capsys.readouterr().err
    # What is kept for the page of real recordings, to four digits.
    kept = sites.left_out_levels("uwb", "hall-2")
    assert kept == pytest.approx(judged["hall-1"]["other sites"], rel=1e-3)
    assert sites.left_out_levels("uwb", "yard-1") == {}
    assert sites.left_out_levels("bearings", "hall-1") == {}


def test_levels_that_one_site_has_set_have_no_other_site(root, monkeypatch):
    monkeypatch.setattr(module, "site_of", lambda tracker, name: "hall")
    with pytest.raises(UnusableInput, match="all recordings of bearings are of one site"):
        default_levels("bearings", left_out=True)


def test_a_fit_without_a_site_reads_so_many_ranges_of_a_recording(root, monkeypatch):
    whole = read_recording(root / "hall-1")
    assert shortened(whole).tables["ranges"].equals(whole.tables["ranges"])
    monkeypatch.setattr(module, "MOST_RANGES", 40)
    assert 30 <= shortened(whole).tables["ranges"].height <= 40


@pytest.mark.slow
def test_a_site_left_out_is_judged_filtered_and_smoothed_beside_the_present_levels(root):
    default_levels("uwb", left_out=True, output=Output(small=True, out=root / "levels.json"))
    tables = json.loads((root / "levels.json").read_text("utf-8"))["tables"]
    rows = tables["Sites left out"]
    assert [(row["recording"], row[""]) for row in rows] == [
        (name, kind) for name in ("hall-1*", "hall-2", "shed-1*") for kind in ESTIMATES
    ]
    assert [*tables["levels"][0]] == ["level", "present", "all sites", "without hall", "without shed"]
    folder = read_recording(root / "hall-2")
    metrics = evaluate(build("uwb", folder).run(folder), folder).overall
    assert [row["RMSE, present"] for row in rows[3:5]] == 2 * [f"{metrics['rmse_m']:.3f}"]
    inside = f"{100 * metrics['coverage_95']:.1f} %, {metrics['nees_ratio']:.2f}"
    assert rows[4]["inside 95 %, NEES/dof, present"].strip("*") == inside
    named = at_levels(build("uwb", folder), {"bias": 0.3, "sigma_bias": 0.2})
    assert [np.unique(named.values[name]) for name in ("sensors.ranges.bias", "start.sigma_bias")] == [[0.3], [0.2]]
