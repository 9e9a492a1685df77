"""C sources of trackers: compiled without a warning, and equal to `run` row by row, statuses included."""

from __future__ import annotations

import shutil
import subprocess

import jax
import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.c_source import c_source, rows_of, write_c

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
SLOW = [pytest.param(*x, marks=pytest.mark.slow) for x in (("agv", "fix-kf"), ("fusion", "bearings"), ("tdoa", "tdoa"))]
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-DTAG_MAIN")
pytestmark = pytest.mark.skipif(not COMPILERS, reason="neither gcc nor clang is installed")


def _batch(world, tracker):
    folder = getattr(tw.simulate, world)(1, 1).folder()
    return tw.build(tracker, folder).batches(folder)[0]


def _replayed(source, recording, folder, compiler=None):
    """The outputs (T, …) of the program of a source for the rows of a recording."""
    (folder / "tag.h").write_text(source.header)
    (folder / "tag.c").write_text(source.body)
    subprocess.run([compiler or COMPILERS[0], *FLAGS, "tag.c", "-o", "tag", "-lm"], cwd=folder, check=True)
    rows = "\n".join(",".join(f"{x!r}" for x in row) for row in rows_of(recording, source.columns).tolist())
    done = subprocess.run([folder / "tag"], input=rows + "\n", capture_output=True, text=True, check=True)
    return np.array([[float(x) for x in line.split(",")] for line in done.stdout.splitlines()])


def _mean(estimates):
    return np.stack([np.asarray(x, float) for x in jax.tree_util.tree_leaves(estimates.mean)], axis=-1)


@pytest.mark.parametrize(("world", "name"), [("ranges", "uwb"), *SLOW])
def test_the_program_gives_the_estimates_and_statuses_of_run(world, name, tmp_path):
    batch = _batch(world, name)
    recording = batch.trajectories[0].recording
    source = c_source(batch.tracker, recording, "tag", double=True)
    found, expected = _replayed(source, recording, tmp_path), batch.tracker.run(recording)
    usable = np.asarray(expected.usable)
    assert usable.sum() > 100
    np.testing.assert_array_equal(found[:, -1], np.asarray(expected.status))
    # Means against their standard deviations; in double precision rounding is far below.
    sigma = np.stack([np.asarray(x, float) for x in expected.sigmas.values()], axis=-1)
    mean = _mean(expected)
    width = min(mean.shape[1], sigma.shape[1], 3)
    assert (np.abs(found[:, :width] - mean[:, :width])[usable] <= 1e-8 * sigma[usable][:, :width]).all()
    np.testing.assert_allclose(found[usable, -5], np.asarray(expected.log_likelihood)[usable], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_single_precision_compiles_without_a_warning_and_agrees_to_its_rounding(compiler, tmp_path):
    batch = _batch("ranges", "uwb")
    recording = batch.trajectories[0].recording
    source = c_source(batch.tracker, recording, "tag", about="uwb of a test")
    assert "uwb of a test" in source.header
    assert "sensors.ranges.sigma_r" in source.header
    found, expected = _replayed(source, recording, tmp_path, compiler), batch.tracker.run(recording)
    usable = np.asarray(expected.usable)
    sigma = np.asarray(expected.sigmas["position.0"])
    np.testing.assert_array_equal(found[:, -1], np.asarray(expected.status))
    assert (np.abs(found[:, 0] - expected.mean.position[0])[usable] <= 1e-4 * sigma[usable]).all()


@pytest.mark.slow
def test_a_tracker_whose_start_searches_begins_with_a_belief(tmp_path):
    batch = _batch("station", "beam")
    recording = batch.trajectories[0].recording
    source = c_source(batch.tracker, recording, "tag", double=True)
    whole = batch.tracker.run(recording)
    mean, cov = _mean(whole)[0], np.asarray(whole.cov_upper)[:, 0]
    begin = "{ double m[4] = {%s}, c[10] = {%s}; tag_begin(&state, m, c); }"
    begun = begin % (", ".join(map(repr, mean.tolist())), ", ".join(map(repr, cov.tolist())))
    source = source._replace(body=source.body.replace("tag_init(&state);\n    for", f"{begun}\n    for"))
    rest = tw.Recording(
        recording.times[1:],
        {key: tw.Readings(x.values[1:], x.seen[1:]) for key, x in recording.readings.items()},
        {key: x[1:] for key, x in recording.inputs.items()},
    )
    found = _replayed(source, rest, tmp_path)
    first = found[0]
    assert first[-1] == 0
    np.testing.assert_allclose(found[:, 0], np.asarray(whole.mean.azimuth)[1:], atol=5e-3)


def test_a_filter_of_ones_own_matrices_leaves_as_c(tmp_path):
    tracker = tw.linear([[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0]], 0.1 * np.eye(2), [[2.0]], x0=[0.0, 0.0])
    z = np.random.default_rng(0).normal(size=50).cumsum()
    z[7:9] = np.nan
    recording = tw.series(z)
    found = _replayed(c_source(tracker, recording, "tag", double=True), recording, tmp_path)
    np.testing.assert_allclose(found[:, :2], _mean(tracker.run(recording)), rtol=1e-9, atol=1e-9)


def test_powers_of_zero_halves_and_names_with_a_digit_or_a_comment_are_right(tmp_path):
    def measured(x):
        return [sum(c * x[0] ** k for k, c in enumerate([0.1, 1.0, 0.02])) + 0.25 * jax.lax.round(2.5 + 0.0 * x[0])]

    tracker = tw.nonlinear(lambda x, dt: x, {"1*/": measured}, 0.01 * np.eye(1), {"1*/": [[0.1]]}, x0=[1.0])
    recording = tw.series({"1*/": np.sin(np.arange(9.0))})
    found = _replayed(c_source(tracker, recording, "tag", double=True), recording, tmp_path)
    with jax.enable_x64(True):
        np.testing.assert_allclose(found[:, 0], tracker.run(recording).mean.x[0], rtol=1e-7)


def test_names_that_are_one_in_c_are_refused():
    levels = {name: [[0.1]] for name in ("a b", "a_b")}
    tracker = tw.nonlinear(lambda x, dt: x, {name: lambda x: x for name in levels}, np.eye(1), levels, x0=[1.0])
    with pytest.raises(tw.UnusableInput, match="both a_b_values_0"):
        c_source(tracker, tw.series({name: np.ones(3) for name in levels}))


@pytest.mark.parametrize(("world", "name"), [("line", "line-pf"), ("agv", "mhk")])
def test_a_tracker_that_draws_or_looks_back_is_refused(world, name):
    batch = _batch(world, name)
    with pytest.raises(tw.UnusableInput, match="expected"):
        c_source(batch.tracker, batch.trajectories[0].recording)


def test_source_header_and_rows_are_written_that_main_replays(tmp_path):
    folder = tw.simulate.agv(1, 1, rows=60).folder()
    written = write_c(tw.build("fix-kf", folder), folder, tmp_path / "tag.c")
    assert [path.name for path in written] == ["tag.c", "tag.h", "tag.csv"]
    subprocess.run([COMPILERS[0], *FLAGS, tmp_path / "tag.c", "-o", tmp_path / "tag", "-lm"], check=True)
    rows = (tmp_path / "tag.csv").read_text()
    done = subprocess.run([tmp_path / "tag"], input=rows, capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == 60
