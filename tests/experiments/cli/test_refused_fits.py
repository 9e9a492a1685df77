"""`tune` writes no values that make things worse, unless forced, and says what to do."""

import json
import tomllib
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.in_process import trackwright
from tests.tuning.worlds import line_tracker, walks
from trackwright.experiments.cli.tuning_folder import in_words, refusals, table
from trackwright.experiments.pages.reports.before_after import Compared, worse
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, write_recording
from trackwright.tuning.fitting import fit
from trackwright.tuning.parameters import by_label, flatten, select_parameters

FIT = ("--tracker", "fix-kf", "--tune", "sensors.fixes.sigma_horizontal", "--starts", 1, "--no-figures")


def _walk(path, seed, sigma, rows=200):
    """Fixes of a tag that walks at random over the floor, with errors of `sigma` m, and its truth."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(0.05 * rng.normal(size=(rows, 3)), axis=0) * [1, 1, 0] + [2.0, 3.0, 1.0]
    tables = {
        kind: pl.DataFrame(
            {"t_s": np.arange(rows) * 0.2, "tag": "7"} | {f"{a}_m": values[:, k] for k, a in enumerate("xyz")}
        )
        for kind, values in (("fixes", place + sigma * rng.normal(size=place.shape)), ("truth", place))
    }
    write_recording(RecordingFolder(path.name, None, Rig(path.name, tags={"7": Tag(1.0)}), tables), path)
    return path


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """Three recordings, one with errors of a metre: the others' values are no good for it."""
    folder = tmp_path_factory.mktemp("walks")
    return [_walk(folder / f"hall-{k}", k, sigma) for k, sigma in enumerate((0.03, 0.03, 1.0))]


def test_values_that_make_a_recording_worse_are_not_written_without_force(unlike, tmp_path):
    out = tmp_path / "fit"
    out.mkdir()
    (out / "tuned.toml").write_text("of an earlier fit")
    said = trackwright("tune", *unlike, *FIT, "--json", "--out", out)
    assert said.code == 1, said.err
    last = said.err.splitlines()[-1]
    assert f"{out / 'tuned.toml'} is not written: " in last
    assert "hall-2: " in last
    assert " % in the 95 % ellipse, NEES/dof " in last
    assert last.endswith("--force writes it all the same")
    assert sorted(x.name for x in out.iterdir()) == ["checkpoint.npz", "manifest.json", "report.html", "trace.csv"]
    assert "is not written" in (out / "report.html").read_text("utf-8")
    assert "Recordings tuned on, each with values fitted to the others, before → after" in said.err
    assert json.loads(said.out)["refused"].endswith(last.partition(" is not written: ")[2])
    forced = trackwright("tune", *unlike, *FIT, "--resume", "--force", "--no-report", "--out", out)
    assert forced.code == 0, forced.err
    assert tomllib.loads((out / "tuned.toml").read_text())["tunables"].keys() == {"sensors.fixes.sigma_horizontal"}


def test_values_that_serve_every_recording_are_written(tmp_path):
    alike = [_walk(tmp_path / f"walk-{k}", k, 0.3) for k in (1, 2, 3)]  # as many as above: the same programs
    said = trackwright("tune", *alike, *FIT, "--no-report", "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    assert (tmp_path / "fit" / "tuned.toml").exists()


def test_a_fit_that_ended_early_is_not_written(tmp_path):
    still = [_walk(tmp_path / f"still-{k}", k, 0.0) for k in (3, 4, 5)]
    said = trackwright("tune", *still, *FIT, "--steps", 1, "--no-report", "--out", tmp_path / "early")
    assert said.code == 1
    assert "the fit ended before its optimum. Usual fix: more --steps or --starts" in said.err.splitlines()[-1]


def test_a_level_that_collapsed_is_refused_with_the_usual_fix():
    levels = ("motion.sigma_v", "sensors.gauge.sigma")
    result = fit(line_tracker(0.3, 30.0), walks([600], 3, sigma=0.0), "nll", levels)
    (found,) = refusals(result, Compared("", (), (), ()), held_out=False)
    assert found.text.startswith("sensors.gauge.sigma collapsed to ")
    line = in_words([found])
    assert line.endswith("Usual fix: --freeze it or --bound it, or --average repeats; --force writes it all the same")
    assert "\n" not in line


def test_a_tuned_number_without_a_unit_has_none_in_the_table():
    parameters = select_parameters(tw.fix_tracker(dof=4.0), ["sensors.fixes.*"])
    values = by_label(parameters, flatten(parameters))
    result = SimpleNamespace(
        parameters=parameters, values=values, starts=[[SimpleNamespace(values=values)]], start_value=1.0, value=0.5
    )
    units = {line.split()[0]: line.split()[4:] for line in table(result, "nll", {}).splitlines()}
    assert (units["sensors.fixes.dof"], units["sensors.fixes.sigma_horizontal"]) == ([], ["m"])


METRICS = {"recording": "hall", "rmse_m": 0.1, "coverage_95": 0.95, "nees_ratio": 1.0}


@pytest.mark.parametrize(
    ("old", "new", "clauses"),
    [
        ({}, {"rmse_m": 0.1049, "coverage_95": 0.91}, []),
        ({}, {"rmse_m": 0.106}, ["hall: horizontal RMSE 10.0 → 10.6 cm"]),
        (
            {},
            {"coverage_95": 0.40, "nees_ratio": 9.0},
            [
                "hall: 95 → 40 % in the 95 % ellipse, NEES/dof 1.00 → 9.00 (held before; limits 88 to 99 % and limits 0.67 to 1.4)"
            ],
        ),
        ({"coverage_95": 0.5}, {"coverage_95": 0.46}, []),
        ({"coverage_95": 0.5}, {"coverage_95": 0.44}, ["hall: 50 → 44 % in the 95 % ellipse, NEES/dof 1.00 → 1.00"]),
        ({}, {"rmse_m": None}, []),
        ({"coverage_95": None}, {"coverage_95": None}, []),
    ],
)
def test_what_makes_a_recording_worse(old, new, clauses):
    assert list(worse(METRICS | old, METRICS | new, "rmse_m", "")) == clauses
    space = [{k.replace("rmse_m", "rmse_3d_m"): v for k, v in side.items()} for side in (METRICS | old, METRICS | new)]
    space = [side | {"coverage_95_3d": side["coverage_95"], "nees_3d_ratio": side["nees_ratio"]} for side in space]
    found = [
        text.replace("3-D RMSE", "horizontal RMSE").replace("ellipsoid", "ellipse")
        for text in worse(*space, "rmse_3d_m", "_3d")
    ]
    assert found == clauses
