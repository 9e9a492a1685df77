"""Plots for notebooks return axes with what they were given, and a page that plays them back."""

from __future__ import annotations

import base64
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
    recording = tw.baselines.fix_recording(times, path + noise, truth=path)
    return recording, tw.baselines.fix_tracker().run(recording)


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


@pytest.mark.slow
def test_a_floor_plan_draws_estimates_truth_and_nothing_else(run, in_arrays):
    recording, estimates = run
    axes = tw.plot.floor_plan(estimates, recording, tags=["1"])
    rows = estimates.to_polars().filter(tag="1")
    drawn = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(drawn["tag 1"].get_xdata(), rows["x_m"].to_numpy())
    np.testing.assert_allclose(drawn["truth"].get_xdata(), recording.tables["truth"].filter(tag="1")["x_m"], atol=1e-9)
    assert {text.get_text(): text.xy for text in axes.texts} == {k: (*p[:2],) for k, p in recording.rig.anchors.items()}
    assert tw.plot.floor_plan(in_arrays[1], in_arrays[0], ax=axes) is axes
    with pytest.raises(UnusableInput, match="no estimate of tag '9'"):
        tw.plot.floor_plan(estimates, recording, tags=["9"])


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
    bare = tw.baselines.fix_recording(in_arrays[0].times, in_arrays[0].readings["fixes"].values)
    with pytest.raises(UnusableInput, match="no truth"):
        tw.plot.error_cdf(in_arrays[1], bare)


def test_a_playback_holds_every_estimate_of_each_run(run, in_arrays, tmp_path):
    recording, estimates = run
    other, (array, own) = tw.build("median", recording).run(recording), in_arrays
    bare = tw.baselines.fix_recording(array.times, array.readings["fixes"].values)
    for shown, of, scored in (
        (tw.plot.playback({"fix-kf": estimates, "median": other}, recording), (estimates, other), True),
        (tw.plot.playback(own, array), (own,), True),
        (tw.plot.playback(tw.baselines.fix_tracker().run(bare), bare), (own,), False),
    ):
        assert len(repr(shown)) < 200
        assert shown._repr_html_().startswith("<iframe ")
        page = shown.save(tmp_path / "page.html").read_text("utf-8")
        for one, table in zip(json.loads(page.split('id="data">')[1].split("</script>")[0])["runs"], of, strict=True):
            (held,), x = one["recordings"], table.to_polars()["x_m"].to_numpy()
            drawn = np.frombuffer(base64.b64decode(held["columns"]["v0"]["bdata"]), "<f4")
            np.testing.assert_allclose(np.sort(drawn), np.sort(x), rtol=1e-6, atol=1e-6)
            assert (held["rows"], bool(one["metrics"])) == (len(x), scored)
