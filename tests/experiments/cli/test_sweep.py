"""`trackwright sweep`: the table and figure it writes, what it says, and input that it refuses in one line."""

import json

import numpy as np
import polars as pl
import pytest

from tests.in_process import trackwright

KALMAN = "--tracker", "fix-kf"
SIGMA_A, SIGMA_P = "motion.sigma_a", "sensors.fixes.sigma_horizontal"


@pytest.fixture(scope="module")
def fixes(tmp_path_factory):
    """A recording of fixes that a Kalman filter tracks: it compiles at once."""
    rng = np.random.default_rng(3)
    folder = tmp_path_factory.mktemp("fixes") / "walk"
    folder.mkdir()
    times = np.arange(80) * 0.2
    place = np.cumsum(0.1 * rng.normal(size=(80, 3)), axis=0) + [2.0, 3.0, 1.0]
    read = place + 0.25 * rng.normal(size=place.shape)
    ids = {"t_s": times, "tag": ["7"] * 80}
    for name, values in (("fixes", read), ("truth", place)):
        table = pl.DataFrame(ids | {f"{a}_m": values[:, k] for k, a in enumerate("xyz")})
        table.write_parquet(folder / f"{name}.parquet")
    (folder / "rig.toml").write_text('format = 1\nname = "walk"\n')
    return folder


@pytest.fixture(scope="module")
def once(fixes):
    """One number by RMSE; what was said, and the folder."""
    out = fixes.parent / "once"
    options = "--over", f"{SIGMA_P}=0.05:1.2:6", "--figures", "pdf"
    return trackwright("sweep", fixes, *KALMAN, *options, "--out", out), out


@pytest.fixture(scope="module")
def twice(fixes):
    """Two numbers by likelihood."""
    out = fixes.parent / "twice"
    grids = "--over", f"{SIGMA_A}=0.1:1:3", "--over", f"{SIGMA_P}=0.1:0.6:4"
    return trackwright("sweep", fixes, *KALMAN, *grids, "--objective", "nll", "--out", out), out


def test_the_table_has_a_row_for_every_value_and_the_best_is_printed(once):
    said, out = once
    assert said.code == 0, said
    table = pl.read_csv(out / "sweep.csv")
    assert table.columns == [SIGMA_P, "rmse"]
    np.testing.assert_allclose(table[SIGMA_P], np.linspace(0.05, 1.2, 6))
    best = table.row(table["rmse"].arg_min(), named=True)
    assert f"best {SIGMA_P} = {best[SIGMA_P]:.6g} m" in said.out
    assert f"rmse = {best['rmse']:.6g} m" in said.out
    assert "6 trajectories filtered" in said.out
    assert (out / "sweep.pdf").read_bytes().startswith(b"%PDF")
    assert "sweep.pdf" in said.out


def test_a_sweep_gives_what_track_and_evaluate_give_at_the_same_value(once, fixes):
    table = pl.read_csv(once[1] / "sweep.csv")
    value, rmse = table.row(2)
    noise, out = fixes.parent / "noise.toml", fixes.parent / "tracked"
    noise.write_text(f'[tunables."{SIGMA_P}"]\nvalue = {value!r}\n')
    assert trackwright("track", fixes, *KALMAN, "--noise", noise, "--out", out).code == 0
    figures = json.loads(trackwright("evaluate", out, "--json").out)
    # single precision in the filter
    assert figures["overall"]["rmse_m"] == pytest.approx(rmse, rel=1e-4)


def test_two_numbers_give_every_pair_and_a_figure(twice):
    said, out = twice
    assert said.code == 0, said
    table = pl.read_csv(out / "sweep.csv")
    assert len(table) == 12
    assert table.select(SIGMA_A, SIGMA_P).unique().height == 12
    assert (out / "sweep.png").stat().st_size > 1000
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["filter_runs"] == 12
    assert set(manifest["best"]) == {SIGMA_A, SIGMA_P}
