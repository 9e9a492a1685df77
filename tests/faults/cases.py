"""The kinds of cases: what is broken and which command gets it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from tests.faults.judged import faults_of
from tests.faults.recordings import broken_recording
from tests.faults.sources import broken_source
from tests.faults.texts import CALIBRATION, MAPPING, POINTS, STUDY, TUNED, broken_file, broken_toml, damage
from tests.faults.values import pick
from tests.faulty import good_tables, write_good
from tests.in_process import trackwright

TRACKERS = {
    "ranges": ("uwb", "multilateration"),
    "fixes": ("fix-kf", "moving-average", "median"),
    "bearings": ("bearings",),
    "phases": ("das",),
    "imu": ("uwb-imu",),
}
"""Trackers of few parts by the table that they read."""


SMALL = STUDY.partition("[worlds.other]")[0] + '[trackers.fix-kf]\n[trackers.window]\ntracker = "moving-average"\n'


@cache
def stores() -> Path:
    """A folder with a recording `good`, tracks `run` and `other`, a `study.toml` and its `study`, and a fit `fit`."""
    folder = Path(tempfile.mkdtemp(prefix="stores-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    write_good(folder / "good")
    for table in ("ranges", "bearings", "phases", "imu"):
        (folder / "good" / f"{table}.csv").unlink()
    for table in ("fixes", "truth"):
        good_tables()[table].write_csv(folder / "good" / f"{table}.csv")
    (folder / "study.toml").write_text(SMALL)
    (folder / "points.csv").write_text(POINTS)
    quick = ("--no-figures", "--no-report")
    for name, tracker in (("run", "fix-kf"), ("other", "moving-average")):
        _done("track", folder / "good", "--tracker", tracker, *quick, "--out", folder / name)
    _done("study", folder / "study.toml", *quick, "--out", folder / "study")
    _done(*fit_command(folder))
    return folder


def fit_command(folder: Path) -> tuple:
    """The command of the fit in the folder."""
    few = ("--steps", 2, "--force", "--starts", 1, "--free-height", "--no-figures", "--no-report")
    return "tune", folder / "good", "--tracker", "fix-kf", *few, "--out", folder / "fit", "--resume"


def _done(*words: str | Path | int) -> None:
    result = trackwright(*words)
    if result.code:
        raise RuntimeError(f"{words}: {result.err}")


def _tracker(seed: int, number: int, folder: Path, among: tuple[str, ...] = tuple(TRACKERS)) -> str:
    """A tracker for a table that is there, if there is one."""
    draw = np.random.default_rng([seed, number, 1])
    tables = [name for name in among if any(folder.glob(f"{name}.*"))] or [*among]
    return pick(draw, TRACKERS[pick(draw, tables)])


def checked(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A broken recording through `check`."""
    folder, words = broken_recording(seed, number, place)
    return words, *faults_of(("check", folder), folder)


def tracked(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A recording with one fault through `track`."""
    folder, words = broken_recording(seed, number, place, 1)
    tracker, out = _tracker(seed, number, folder), place / "out"
    run = ("track", folder, "--tracker", tracker, "--no-figures", "--no-report", "--out", out)
    return f"{words} ({tracker})", *faults_of(run, folder, out)


def tuned(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A recording with one fault through `tune`."""
    folder, words = broken_recording(seed, number, place, 1)
    tracker, out = _tracker(seed, number, folder, ("ranges", "fixes", "bearings")), place / "out"
    few = ("--steps", 1, "--force", "--starts", 1, "--free-height", "--no-figures", "--no-report")
    return f"{words} ({tracker})", *faults_of(("tune", folder, "--tracker", tracker, *few, "--out", out), folder, out)


def toml_read(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A broken file of tuned values, calibration, mapping or study through the command that reads it."""
    draw, good = damage(seed, number), stores() / "good"
    kind = pick(draw, ("tuned", "calibration", "study", "mapping"))
    path, out = place / f"{kind}.toml", place / "out"
    quick = ("--no-figures", "--no-report", "--out", out)
    path.write_bytes(
        broken_toml(draw, {"tuned": TUNED, "calibration": CALIBRATION, "study": STUDY, "mapping": MAPPING}[kind])
    )
    if kind == "study":
        # Its declaration alone: it may ask for any amount of work.
        return kind, *faults_of(("study", path, "--runs", 0, *quick), place, out)
    if kind == "mapping":
        (place / "log.csv").write_text("time,who,distance\n1000,A1,2000\n1100,A2,3000\n")
        return kind, *faults_of(("import", place / "log.csv", "--mapping", path, "--out", out), path, out)
    option = {"tuned": "--noise", "calibration": "--calibration"}[kind]
    return kind, *faults_of(("track", good, option, path, "--tracker", "fix-kf", *quick), path, out)


def store_read(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A damaged file of a run, a study or a fit through a command that reads it."""
    draw = damage(seed, number)
    shutil.copytree(stores(), place, dirs_exist_ok=True)
    (place / "run" / "recordings.txt").write_text(f"{place / 'good'}\n")
    what = pick(draw, ("run", "study", "fit"))
    file = pick(draw, sorted(p for p in (place / what).rglob("*") if p.is_file() and p.suffix in READ))
    words = broken_file(draw, file)
    quick = ("--no-figures", "--no-report")
    commands = {
        "run": (("evaluate", place / "run"), ("report", place / "run", place / "other", "--out", place / "out"),
                ("export", place / "run", "--format", "tum", "--out", place / "out")),
        "study": (("study", place / "study.toml", *quick, "--out", place / "study"),
                  ("report", place / "study", stores() / "study", "--out", place / "out")),
        "fit": (fit_command(place),),
    }  # fmt: skip
    command = pick(draw, commands[what])
    return f"{words}, {command[0]}", *faults_of(command, place / "good")


def imported(seed: int, number: int, place: Path) -> tuple[str, str, int]:
    """A broken file of another program through `import`."""
    folder, out = place / "source", place / "out"
    folder.mkdir()
    words, command = broken_source(damage(seed, number), folder)
    return words, *faults_of((*command, "--out", out), folder, out)


READ = (".json", ".parquet", ".npz", ".txt", ".toml")

CASES: dict[str, Callable[[int, int, Path], tuple[str, str, int]]] = {
    "check": checked,
    "track": tracked,
    "tune": tuned,
    "toml": toml_read,
    "stores": store_read,
    "import": imported,
}
