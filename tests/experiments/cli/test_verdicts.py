"""`tune` always writes what it found, with a verdict by left-out recordings; `--check` is for scripts."""

import json
import math
import tomllib
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.in_process import trackwright
from trackwright.experiments.cli.tuning_folder import table
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording
from trackwright.tuning.data import fit_data
from trackwright.tuning.intervals import left_out_blocks
from trackwright.tuning.parameters import by_label, flatten, select_parameters
from trackwright.tuning.tuned_file import read_tuned

FIT = ("--tracker", "fix-kf", "--tune", "sensors.fixes.sigma_horizontal", "--starts", 1)


def _walk(path, seed, sigma, rows=200, truth=True):
    """Fixes of a tag that walks at random over the floor, with errors of `sigma` m, and its truth."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(0.05 * rng.normal(size=(rows, 3)), axis=0) * [1, 1, 0] + [2.0, 3.0, 1.0]
    tables = {
        kind: pl.DataFrame(
            {"t_s": np.arange(rows) * 0.2, "tag": "7"} | {f"{a}_m": values[:, k] for k, a in enumerate("xyz")}
        )
        for kind, values in (("fixes", place + sigma * rng.normal(size=place.shape)), ("truth", place))
        if truth or kind == "fixes"
    }
    write_recording(RecordingFolder(path.name, None, Rig(path.name, tags={"7": Tag(1.0)}), tables), path)
    return path


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """Three recordings, one with errors of a metre: the others' values are no good for it."""
    folder = tmp_path_factory.mktemp("walks")
    return [_walk(folder / f"hall-{k}", k, sigma) for k, sigma in enumerate((0.03, 0.03, 1.0))]


@pytest.fixture(scope="module")
def worse(unlike, tmp_path_factory):
    """The folder of a fit to them, and what was said."""
    out = tmp_path_factory.mktemp("worse")
    return out, trackwright("tune", *unlike, *FIT, "--prior", "flat", "--json", "--out", out)


def test_values_with_which_a_left_out_recording_gets_worse_are_written_with_that_verdict(worse):
    out, said = worse
    assert said.code == 0, said.err
    written = tomllib.loads((out / "tuned.toml").read_text())
    assert written["tunables"].keys() == {"sensors.fixes.sigma_horizontal"}
    assert written["verdict"] == "worse"
    assert written["judged_by"] == "recordings tuned on, each with values fitted to the others"
    assert list(written["recordings"]) == ["hall-0", "hall-1", "hall-2"]
    hall = written["recordings"]["hall-2"]
    assert hall["log_density"]["after"] < hall["log_density"]["before"] - 1.0
    assert hall["log_density"]["high_95"] < 0
    assert (len(hall["rmse_m"]), len(hall["nees_ratio"])) == (2, 2)
    assert json.loads(said.out)["recordings"]["hall-2"] == hall
    for where in (said.err, (out / "report.html").read_text("utf-8")):
        assert f"hall-2 got worse, {hall['log_density']['before']:.2f} → " in " ".join(where.split())
        assert "--steps" not in where
    assert read_tuned(out / "tuned.toml").tracker == "fix-kf"


def test_check_makes_a_worse_verdict_exit_with_one(tmp_path):
    unlike = [_walk(tmp_path / f"hall-{k}", k, sigma) for k, sigma in enumerate((0.05, 0.5))]
    run = ("tune", *unlike, *FIT, "--prior", "flat", "--set", "sensors.fixes.sigma_horizontal=0.2", "--figures", "none")
    codes = [trackwright(*run, *more, "--out", tmp_path / "fit").code for more in ((), ("--check", "--resume"))]
    assert tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())["verdict"] == "worse"
    assert codes == [0, 1]


def test_values_that_serve_every_recording_are_called_better(tmp_path):
    alike = [_walk(tmp_path / f"walk-{k}", k, 0.3) for k in (1, 2, 3)]  # as many as above: the same programs
    said = trackwright("tune", *alike, *FIT, "--figures", "none", "--check", "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())
    assert written["verdict"] == "better"
    assert written["log_density"]["low_95"] > 0
    assert "Verdict: better. Mean log density of the true position, recordings tuned on" in said.out


@pytest.mark.slow
def test_one_recording_is_judged_by_blocks_of_time_and_the_table_says_so(tmp_path):
    said = trackwright("tune", _walk(tmp_path / "one", 4, 0.3), *FIT, "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())
    assert written["verdict"] == "better"
    by = "recording tuned on, each of 4 blocks of time with values fitted without its truth"
    assert written["judged_by"] == by
    assert by in " ".join(said.out.split())
    assert by in " ".join((tmp_path / "fit" / "report.html").read_text("utf-8").split())


def test_without_truth_nothing_is_judged(tmp_path):
    blind = [_walk(tmp_path / f"blind-{k}", k, 0.3, truth=False) for k in (1, 2)]
    said = trackwright("tune", *blind, *FIT, "--figures", "none", "--check", "--out", tmp_path / "fit")
    assert said.code == 0, said.err
    written = tomllib.loads((tmp_path / "fit" / "tuned.toml").read_text())
    assert written["verdict"] == "not judged"
    assert "log_density" not in written
    assert math.isnan(written["recordings"]["blind-1"]["rmse_m"][0])
    assert "Verdict: not judged. No estimate has both a covariance and a truth." in said.out


def test_a_fit_that_ended_early_is_written_and_says_so(tmp_path):
    still = [_walk(tmp_path / f"still-{k}", k, 0.0) for k in (3, 4, 5)]
    said = trackwright(
        "tune",
        *still,
        *FIT,
        "--objective",
        "state-nll+0.1*rmse",
        "--steps",
        1,
        "--figures",
        "none",
        "--out",
        tmp_path / "early",
    )
    assert said.code == 0, said.err
    assert (tmp_path / "early" / "tuned.toml").exists()
    assert "notice: the fit took all its steps before it came to rest" in said.out


def test_a_tuned_number_without_a_unit_has_none_in_the_table():
    tracker = tw.fix_tracker(dof=4.0)
    parameters = select_parameters(tracker, ["sensors.fixes.*"])
    values = by_label(parameters, flatten(parameters))
    result = SimpleNamespace(
        tracker=tracker,
        parameters=parameters,
        values=values,
        starts=[[SimpleNamespace(values=values)]],
        start_value=1.0,
        value=0.5,
    )
    units = {line.split()[0]: line.split()[4:] for line in table(result, "nll", {}).splitlines()}
    assert (units["sensors.fixes.dof"], units["sensors.fixes.sigma_horizontal"]) == ([], ["m"])


@pytest.mark.slow
def test_the_values_without_a_block_of_time_are_those_of_a_fit_to_the_rest_and_compile_nothing(tmp_path):
    folder = read_recording(_walk(tmp_path / "one", 6, 0.3, rows=400))
    named = tw.build("fix-kf", folder)
    data = fit_data(named.only_batch([folder]), "state-nll")
    level = "sensors.fixes.sigma_horizontal"
    flat = tw.FitOptions(prior="flat")
    result = tw.fit(data.tracker, data, data.objective, level, flat)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(listen := lambda name, seconds, **_: compiled.append(name))
    blocks = left_out_blocks(result, data)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert not [name for name in compiled if name.endswith("backend_compile_duration")]
    assert [blocks[0][0], blocks[-1][1], len(blocks)] == [-np.inf, np.inf, 4]
    assert all(a[1] == b[0] for a, b in pairwise(blocks))
    for start, stop, values in blocks[:2]:
        # In holes of that length truth is not interpolated.
        truth = folder.tables["truth"].filter(~pl.col("t_s").is_between(start, stop, "left"))
        rest = replace(folder, tables=folder.tables | {"truth": truth})
        alone = tw.fit(named, rest, "state-nll", level, flat)
        assert float(values[level]) == pytest.approx(float(alone.values[level]), rel=0.01)
        assert abs(np.log(values[level] / result.values[level])) > 0.005
