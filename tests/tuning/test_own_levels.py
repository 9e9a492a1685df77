"""Noise levels by a recording's own readings, beside a Kalman filter in NumPy that knows them."""

import shutil

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from tests.in_process import trackwright
from tests.oracles import kalman, van_loan
from trackwright.sim.corruptions import white_noise
from trackwright.sim.ranging import RangeDraw, chamber
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, write_recording
from trackwright.tuning.own_levels import fitted

pytestmark = pytest.mark.slow

STEP_S, ROWS = 0.1, 400
TIMES = STEP_S * np.arange(ROWS)


def _walk(sigma_a, errors):
    """Fixes with these errors (n, 2), m, of a tag at 1 m whose acceleration is white, and the truth."""
    kicks = sigma_a * np.sqrt(STEP_S) * np.random.default_rng(5).normal(size=(ROWS, 2))
    place = np.cumsum(STEP_S * np.cumsum(kicks, axis=0), axis=0) + [3.0, 2.0]
    tables = {
        kind: pl.DataFrame({"t_s": TIMES, "tag": "T", "x_m": at[:, 0], "y_m": at[:, 1], "z_m": np.ones(ROWS)})
        for kind, at in (("fixes", place + errors), ("truth", place))
    }
    return RecordingFolder("walk", None, Rig("walk", tags={"T": Tag(height=1.0)}), tables)


def _white(sigma):
    return sigma * np.random.default_rng(7).normal(size=(ROWS, 2))


def _kalman_rmse(folder, sigma_a, sigma):
    """The RMSE of the filter that knows both levels."""
    fixes, truth = (folder.tables[kind].select("x_m", "y_m").to_numpy() for kind in ("fixes", "truth"))
    A, noise = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, sigma_a**2])
    steps, H, R = [van_loan(A, noise, STEP_S)] * (ROWS - 1), np.eye(1, 2), np.array([[sigma**2]])
    errors = [fixes[0] - truth[0]]
    for fix, true in zip(fixes.T, truth.T, strict=True):
        mean, cov = np.array([fix[0], 0.0]), np.diag([sigma**2, 1.0])
        seen = np.ones((ROWS - 1, 1), bool)
        errors.append(kalman(steps, H, R, fix[1:, None], seen, mean, cov)[0][:, 0] - true[1:])
    return np.sqrt(sum(np.sum(np.square(e)) for e in errors) / ROWS)


def test_white_ranges_of_anchors_at_one_height_end_without_errors_that_last():
    places = np.array([[0, 0, 3.0], [12, 0, 3], [12, 8, 3], [0, 8, 3], [6, 0, 3], [6, 8, 3]])
    draw = RangeDraw(chamber(places), corruptions={"white": white_noise(0.08)}, n_points=400, rate_hz=5.0)
    folder = draw.drawn(1, seed=2).folder("ceiling")
    own = fitted(named := tw.build("uwb", folder), folder)
    before, after = (tw.evaluate(one.run(folder), folder)["rmse_3d_m"] for one in (named, own.tracker))
    assert after < 0.12 < 0.5 < before


@pytest.mark.parametrize(("sigma_a", "sigma"), [pytest.param(0.02, 0.3, marks=pytest.mark.slow), (2.0, 0.03)])
def test_a_recording_tells_the_levels_of_white_noise_and_motion(sigma_a, sigma):
    folder = _walk(sigma_a, _white(sigma))
    named = tw.build("fix-kf", folder)
    own, known = fitted(named, folder), _kalman_rmse(folder, sigma_a, sigma)
    rmse = [tw.evaluate(x.run(folder), folder).overall["rmse_m"] for x in (named, own.tracker)]
    assert rmse[0] > 1.2 * known
    assert rmse[1] < 1.15 * known
    assert own.tracker.tunables["sensors.fixes.sigma_horizontal"].value == pytest.approx(sigma, rel=0.15)
    assert "sensors.fixes.sigma_horizontal 0.1 → " in own.line


def test_levels_stay_where_errors_last():
    walk, random = _walk(0.3, _white(0.0)), np.random.default_rng(3)
    anchors = {name: np.array([x, y, 2.5]) for name, x, y in (("A", 0, 0), ("B", 6, 0), ("C", 6, 5), ("D", 0, 5))}
    ranges = []
    for name, anchor in anchors.items():
        # An error of each anchor that lasts for some 10 s, and a tenth of it that is white.
        lasting = np.convolve(random.normal(size=2 * ROWS), np.exp(-TIMES / 10.0), "valid")[:ROWS]
        range_m = np.linalg.norm(walk.tables["truth"].select("x_m", "y_m", "z_m").to_numpy() - anchor, axis=1)
        range_m += 0.2 * lasting / lasting.std() + 0.02 * random.normal(size=ROWS)
        ranges.append(pl.DataFrame({"t_s": TIMES, "tag": "T", "anchor": name, "range_m": range_m}))
    rig = Rig("walk", anchors=anchors, tags=walk.rig.tags)
    tables = {"ranges": pl.concat(ranges).sort("t_s"), "truth": walk.tables["truth"]}
    folder = RecordingFolder("walk", None, rig, tables)
    named = tw.build("uwb", folder)
    own = fitted(named, folder)
    assert own.tracker is named
    assert own.line.startswith("walk: levels stay: ")
    assert "errors that last look like motion" in own.line


def test_numbers_that_were_set_stay():
    folder = _walk(0.02, _white(0.3))
    own = fitted(tw.build("fix-kf", folder).with_values({"motion.sigma_a": 0.5}), folder)
    assert own.tracker.values["motion.sigma_a"] == 0.5
    assert own.tracker.tunables["sensors.fixes.sigma_horizontal"].value > 0.2


def test_track_names_the_fit_where_innovations_contradict_the_levels_and_does_it(tmp_path):
    write_recording(_walk(0.02, _white(0.02)), tmp_path / "walk")
    plain = ("track", tmp_path / "walk", "--figures", "none", "--out")
    said = trackwright(*plain, tmp_path / "a")
    assert "--fit fits them to the readings" in " ".join(said.err.split())
    line = "walk: fitted to its readings: motion.sigma_a 1 → "
    said = trackwright(*plain, tmp_path / "b", "--fit")
    assert (said.code, "--fit" in said.err) == (0, False)
    assert line in " ".join(said.err.split())
    shutil.copytree(tmp_path / "walk", tmp_path / "archive" / "walk")
    assert trackwright("track", tmp_path / "archive", *plain[2:], tmp_path / "c", "--fit").code == 0
    assert line in (tmp_path / "c" / "results.csv").read_text("utf-8")
