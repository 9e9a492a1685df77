"""Plots for notebooks return axes with what they were given; objects show as tables; frames of pandas."""

from __future__ import annotations

import base64
import builtins
import json

import matplotlib as mpl
import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.core.errors import UnusableInput

mpl.use("Agg")


@pytest.fixture(scope="module")
def run():
    """Three vehicles and their estimates."""
    recording = tw.simulate.agv(n=3, seed=2, rows=80).folder()
    return recording, tw.build("fix-kf", recording).run(recording)


@pytest.fixture(scope="module")
def in_arrays():
    """A recording in arrays and its estimates."""
    times = np.arange(40) * 0.1
    path = np.stack([times, np.sin(times), 0 * times + 1], axis=1)
    noise = 0.05 * np.random.default_rng(1).normal(size=path.shape)
    recording = tw.fix_recording(times, path + noise, truth=path)
    return recording, tw.fix_tracker().run(recording)


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def test_a_floor_plan_draws_estimates_truth_and_nothing_else(run, in_arrays):
    recording, estimates = run
    axes = tw.plot.floor_plan(estimates, recording, tags=["1"])
    rows = estimates.to_polars().filter(tag="1")
    drawn = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(drawn["tag 1"].get_xdata(), rows["x_m"].to_numpy())
    np.testing.assert_allclose(drawn["truth"].get_xdata(), recording.tables["truth"].filter(tag="1")["x_m"], atol=1e-9)
    anchors = recording.rig.anchors
    texts = {text.get_text(): text.xy for text in axes.texts if not text.get_text().endswith(" s")}
    assert texts == {k: tuple(place[:2]) for k, place in anchors.items()}
    own = tw.plot.floor_plan(in_arrays[1], in_arrays[0], ax=axes)
    assert own is axes
    with pytest.raises(UnusableInput, match="no estimate of tag '9'"):
        tw.plot.floor_plan(estimates, recording, tags=["9"])


def test_errors_over_time_are_those_of_the_evaluation(in_arrays):
    recording, estimates = in_arrays
    axes = tw.plot.error_over_time(estimates, recording)
    error = axes.lines[0].get_ydata()
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(tw.evaluate(estimates, recording)["rmse_m"])


def test_a_distribution_names_the_rmse_of_each_run(run):
    recording, estimates = run
    other = tw.build("median", recording).run(recording)
    axes = tw.plot.error_cdf({"fix-kf": estimates, "median": other}, recording)
    labels = axes.get_legend_handles_labels()[1]
    assert [label.partition(":")[0] for label in labels] == ["fix-kf", "median"]
    rmse = float(labels[0].split()[-2])
    scale = {"m": 1.0, "cm": 100.0, "mm": 1000.0}[labels[0].split()[-1]]
    assert rmse == pytest.approx(scale * tw.evaluate(estimates, recording)["rmse_m"], rel=0.01)
    assert max(line.get_ydata()[-1] for line in axes.lines if "fix-kf" in line.get_label()) == 100


def test_every_chart_draws_on_given_axes_and_refuses_what_it_cannot_show(run, in_arrays):
    import matplotlib.pyplot as plt

    recording, estimates = run
    bearings = tw.simulate.station(n=1, seed=1, rows=20).folder()
    angles = tw.build("beam", bearings).run(bearings)
    with pytest.raises(UnusableInput, match="floor_plan: found bearings"):
        tw.plot.floor_plan(angles, bearings)
    for name in ("floor_plan", "error_over_time", "error_cdf", "coverage", "nees_over_time", "nis_over_time"):
        for of in ((estimates, recording), (angles, bearings))[: 1 + (name != "floor_plan")]:
            axes = plt.figure().subplots()
            assert getattr(tw.plot, name)(*of, ax=axes) is axes
            assert axes.has_data()
    bare = tw.fix_recording(in_arrays[0].times, in_arrays[0].readings["fixes"].values)
    with pytest.raises(UnusableInput, match="no truth"):
        tw.plot.error_cdf(in_arrays[1], bare)


def test_a_playback_holds_every_estimate_of_each_run(run, in_arrays, tmp_path):
    recording, estimates = run
    other = tw.build("median", recording).run(recording)
    for shown, of, names in (
        (tw.plot.playback({"fix-kf": estimates, "median": other}, recording), (estimates, other), ["fix-kf", "median"]),
        (tw.plot.playback(in_arrays[1], in_arrays[0]), (in_arrays[1],), [""]),
    ):
        assert len(repr(shown)) < 200
        assert shown._repr_html_().startswith("<iframe ")
        page = shown.save(tmp_path / "page.html").read_text("utf-8")
        runs = json.loads(page.split('id="data">')[1].split("</script>")[0])["runs"]
        assert [one["name"] for one in runs] == names
        for one, own in zip(runs, of, strict=True):
            (held,) = one["recordings"]
            assert held["rows"] == own.to_polars().height
            x = np.frombuffer(base64.b64decode(held["columns"]["v0"]["bdata"]), "<f4")
            np.testing.assert_allclose(np.sort(x), np.sort(own.to_polars()["x_m"].to_numpy()), rtol=1e-6, atol=1e-6)
            assert one["metrics"][0]["rmse_m"] > 0


def test_a_playback_without_truth_has_no_errors(in_arrays):
    recording = in_arrays[0]
    bare = tw.fix_recording(recording.times, recording.readings["fixes"].values)
    page = tw.plot.playback(tw.fix_tracker().run(bare), bare).html
    (one,) = json.loads(page.split('id="data">')[1].split("</script>")[0])["runs"]
    assert one["metrics"] == []
    assert one["recordings"][0]["tracks"][0]["rmse"] is None


def test_objects_show_as_short_tables(run, in_arrays):
    recording, estimates = run
    for shown in (recording, estimates, tw.evaluate(estimates, recording), *in_arrays, in_arrays[1]):
        html = shown._repr_html_()
        assert html.count("<tr>") < 40
        assert html.startswith("<div>")
        assert len(repr(shown)) < 800
    assert "3 trajectories" in estimates._repr_html_()
    bare = tw.fix_tracker().run(tw.stack([in_arrays[0]]))
    assert "Estimates" in bare._repr_html_()


def test_frames_of_pandas_have_the_columns_of_polars(run, in_arrays, monkeypatch):
    for estimates in (run[1], in_arrays[1]):
        table, frame = estimates.to_polars(), estimates.to_pandas()
        assert list(frame.columns) == table.columns
        np.testing.assert_array_equal(frame["x_m"].to_numpy(), table["x_m"].to_numpy())
    real = builtins.__import__

    def without_pandas(name, *rest, **more):
        if name == "pandas":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without_pandas)
    with pytest.raises(UnusableInput, match="pandas is not installed"):
        in_arrays[1].to_pandas()
