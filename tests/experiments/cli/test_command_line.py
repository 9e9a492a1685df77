"""The command line from end to end on small worlds: files, output and metrics."""

from __future__ import annotations

import json
import shutil

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, assert_refused, trackwright
from trackwright.sim.stations import facing
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.model.rig import Station

TAGS, ROWS, SEED = 6, 40, 3
SIMULATE = ("--n", TAGS, "--rows", ROWS, "--seed", SEED, "--sigma-p", 0.2)
SIGMA_ANGLE = np.deg2rad(2.0)
BEARINGS = ("station", "azimuth_rad", "elevation_rad", "std_azimuth_rad", "std_elevation_rad")


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    """A folder for all runs of this file."""
    return tmp_path_factory.mktemp("command-line")


@pytest.fixture(scope="module")
def world(there):
    """A simulated recording."""
    said = trackwright("simulate", "station", "--out", there / "world", *SIMULATE)
    assert said.code == 0
    tables = f"phases {TAGS * ROWS * 3} rows, truth {TAGS * ROWS} rows"
    assert said.out == f"wrote {there / 'world'}: {TAGS} tags, {tables}\n"
    return there / "world"


@pytest.fixture(scope="module")
def vehicles(there):
    """A recording of position fixes, whose tracker compiles fast."""
    assert trackwright("simulate", "agv", "--out", there / "vehicles", *SIMULATE[:6]).code == 0
    return there / "vehicles"


@pytest.fixture(scope="module")
def runs(there, world, vehicles):
    """The output of `track` for each tracker on its recording, run on first use."""

    class Runs(dict):
        def __missing__(self, tracker):
            read = vehicles if tracker == "fix-kf" else world
            self[tracker] = trackwright(
                "track", read, "--tracker", tracker, "--figures", "png", "--out", there / tracker
            )
            return self[tracker]

    return Runs()


@pytest.fixture(scope="module")
def room(there):
    """Bearings in plain CSV: a tag of known height walks through a room that four stations look into."""
    rng = np.random.default_rng(8)
    times = np.round(np.arange(28) * 0.2, 6)
    place = np.stack([3 + 1.5 * np.cos(0.4 * times), 2.5 + 1.2 * np.sin(0.4 * times), 0 * times + 1.2], axis=1)
    corners = {"NE": (6.0, 5.0, 2.4), "SE": (6.0, 0.0, 2.3), "SW": (0.0, 0.0, 2.4), "NW": (0.0, 5.0, 2.2)}
    middle = np.array([3.0, 2.5, 1.2])
    stations = {k: Station(np.array(p), facing(np.array(p), middle, (0.0, 0.0, 1.0))) for k, p in corners.items()}
    folder = there / "room"
    folder.mkdir()
    lines = ["format = 1", 'name = "room"']
    for name, station in stations.items():
        lines += [f"[stations.{name}]", f"position_m = {station.position.tolist()}"]
        lines += [f"rotation_wxyz = {station.rotation.tolist()}"]
    (folder / "rig.toml").write_text("\n".join([*lines, "[tags.walker]", "height_m = 1.2", ""]))
    seen = {name: s.angles(place) + SIGMA_ANGLE * rng.normal(size=(len(times), 2)) for name, s in stations.items()}
    rows = [(t, "walker", name, *seen[name][k]) for k, t in enumerate(times) for name in stations]
    pl.DataFrame(rows, ["t_s", "tag", "station", "azimuth_rad", "elevation_rad"], orient="row").write_csv(
        folder / "bearings.csv"
    )
    truth = {"t_s": times, "tag": ["walker"] * len(times)} | dict(zip(("x_m", "y_m", "z_m"), place.T, strict=True))
    pl.DataFrame(truth).write_csv(folder / "truth.csv")
    return folder


def _overall(folder, *options):
    said = trackwright("evaluate", folder, "--json", *options)
    assert said.code == 0
    return json.loads(said.out)["overall"]


def _pictures(folder):
    files = list(folder.glob("*.png"))
    assert all(file.read_bytes().startswith(b"\x89PNG\r\n\x1a\n") for file in files)
    return {file.stem for file in files}


def test_simulate_writes_a_recording_and_what_it_was_made_with(world):
    assert sorted(p.name for p in world.iterdir()) == ["manifest.json", "phases.parquet", "rig.toml", "truth.parquet"]
    phases, truth = (pl.read_parquet(world / f"{name}.parquet") for name in ("phases", "truth"))
    assert (phases.height, truth.height) == (TAGS * ROWS * 3, TAGS * ROWS)
    manifest = json.loads((world / "manifest.json").read_text())
    assert manifest["seeds"] == [SEED]
    assert manifest["config"]["n"] == TAGS
    assert manifest["command"][:2] == ["trackwright", "simulate"]


def test_corruptions_are_in_the_recording(there):
    options = (
        "--lost-station",
        2,
        "--masked-antenna",
        1,
        3,
        "--drop-outs",
        0.2,
        "--outliers",
        0.05,
        "--gauss-markov",
        0.1,
    )
    assert trackwright("simulate", "station", "--out", there / "bad-day", *SIMULATE, *options).code == 0
    phases = pl.read_parquet(there / "bad-day" / "phases.parquet")
    assert set(phases["station"]) == {"1", "3"}
    assert phases.filter(station="1")["phase_3_rad"].null_count() == phases.filter(station="1").height
    assert 0.6 < phases.height / (2 * TAGS * ROWS) < 0.95
    said = trackwright("check", there / "bad-day")
    assert "stations never observed: 1 of 3 (2)" in said.out
    assert "phase_3_rad" in said.out


def test_a_simulated_recording_passes_all_checks(world):
    said = trackwright("check", world)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith(f"{world}\n")
    assert "10 Hz" in said.out
    assert "dilution of precision" in said.out
    assert "errors: 0, warnings: 0" in said.out


@pytest.mark.parametrize("tracker", ["beam", "das"])
def test_bearing_trackers_write_azimuth_and_elevation_per_station(runs, there, tracker):
    assert runs[tracker].code == 0, runs[tracker]
    tracks = pl.read_parquet(there / tracker / "tracks.parquet")
    assert set(BEARINGS) <= set(tracks.columns)
    assert "x_m" not in tracks.columns
    assert tracks.height == TAGS * ROWS * 3
    assert tracks.select("recording", "tag", "station", "t_s").is_unique().all()
    assert tracks["azimuth_rad"].null_count() == 0
    # delay-and-sum reports no covariance
    assert tracks["std_azimuth_rad"].null_count() == (tracks.height if tracker == "das" else 0)


@pytest.mark.parametrize(
    ("tracker", "pictures"),
    [
        ("fix-kf", {"floor-plan", "error-cdf", "error-over-time", "nees-over-time", "nis-over-time", "coverage"}),
        ("beam", {"error-cdf", "error-over-time", "nees-over-time", "nis-over-time", "coverage"}),
    ],
)
def test_a_run_folder_has_a_manifest_and_plots(runs, there, world, vehicles, tracker, pictures):
    said, folder, read = runs[tracker], there / tracker, world if tracker == "beam" else vehicles
    assert pictures == _pictures(folder)
    assert said.out.splitlines()[0].endswith("ok")
    assert said.out.splitlines()[-1].startswith(f"wrote {folder / 'tracks.parquet'} (")
    assert f"{len(_pictures(folder))} figure" in said.out.splitlines()[-1]
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["config"]["tracker"], manifest["config"]["seed"]) == (tracker, 0)
    assert manifest["recordings"] == [str(read)]
    assert manifest["verdicts"] == {"ok": TAGS * (3 if tracker == "beam" else 1)}
    assert manifest["versions"]["jax"]
    assert (folder / "recordings.txt").read_text() == f"{read.resolve()}\n"
    assert not [p.name for p in folder.iterdir() if p.name.startswith(".")]


def test_evaluate_prints_a_table_and_writes_the_metrics(runs, there):
    said = trackwright("evaluate", there / "fix-kf") if runs["fix-kf"].code == 0 else None
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("Horizontal and 3-D position errors in ")
    assert said.out in runs["fix-kf"].out
    assert "all 6" in said.out
    kept = json.loads((there / "fix-kf" / "evaluation.json").read_text())
    assert kept["overall"] == _overall(there / "fix-kf")
    assert len(kept["tracks"]) == TAGS


def test_fail_if_decides_the_exit_code(runs, there):
    assert runs["fix-kf"].code == 0
    passed = trackwright("evaluate", there / "fix-kf", "--fail-if", "p95_m>0.5 or lost_fraction>0")
    assert (passed.code, passed.err) == (0, "")
    failed = trackwright("evaluate", there / "fix-kf", "--fail-if", "p95_m>0.0001")
    assert failed.code == 1
    assert failed.err.startswith("fails: p95_m>0.0001 (p95_m is ")
    assert failed.out == passed.out


def test_without_truth_tracks_are_written_but_not_evaluated(runs, there, vehicles):
    assert runs["fix-kf"].code == 0
    blind = there / "blind"
    shutil.copytree(vehicles, blind)
    (blind / "truth.parquet").unlink()
    said = trackwright("track", blind, "--tracker", "fix-kf", "--figures", "png", "--out", there / "blind-run")
    assert said.code == 0
    assert "errors in" not in said.out
    assert _pictures(there / "blind-run") == {"floor-plan", "nis-over-time"}
    seen, unseen = (pl.read_parquet(there / name / "tracks.parquet") for name in ("fix-kf", "blind-run"))
    assert seen.equals(unseen)
    assert_refused(
        trackwright("evaluate", there / "blind-run"), str(blind), "no truth table", "give recordings that have one"
    )
    assert _overall(there / "blind-run", "--truth", vehicles) == _overall(there / "fix-kf")


def test_the_trackers_are_listed_with_their_tables():
    said = trackwright("trackers")
    assert said.code == 0
    named = [line.split()[0] for line in said.out.splitlines() if line[2:3].strip()]
    assert sorted(named) == sorted(TRACKERS)
    assert max(map(len, said.out.splitlines())) <= 80
    for entry in TRACKERS.values():
        assert entry.table in " ".join(said.out.split())


def test_bearings_of_a_walk_are_tracked_at_the_known_height(there, room):
    said = trackwright("track", room, *PLAIN, "--out", there / "walk")
    assert said.code == 0
    assert "tracker: bearings (" in said.err
    assert "height: known from rig.toml for 1 tag and used; estimate it with --free-height" in said.err
    tracks = pl.read_parquet(there / "walk" / "tracks.parquet")
    # four stations at once: one estimate for each time
    assert tracks.height == 28
    assert (tracks["z_m"] == 1.2).all()
    assert (tracks["std_z_m"] == 0).all()
    metrics = _overall(there / "walk")
    assert "3-D RMSE" not in " ".join(said.out.split()), "the error of a given height is not the tracker's"
    # The defaults expect stations with biases of 0.2 rad, which these have not.
    assert metrics["rmse_m"] < 0.25
    assert metrics["rmse_3d_m"] is None or metrics["rmse_3d_m"] == pytest.approx(metrics["rmse_m"])


def test_free_height_estimates_the_height_too(there, room):
    said = trackwright("track", room, "--free-height", *PLAIN, "--out", there / "free")
    assert said.code == 0
    assert "height" not in said.err
    tracks = pl.read_parquet(there / "free" / "tracks.parquet")
    assert (tracks["std_z_m"] > 0).all()
    assert tracks["z_m"].n_unique() == 28
    metrics = _overall(there / "free")
    assert metrics["rmse_m"] < 0.25
    assert metrics["rmse_3d_m"] < 0.25
