"""What commands wrote, for cases that damage it: tracks, studies, fits; made once in a process."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from tests.faults.texts import POINTS, STUDY
from tests.faulty import good_tables, write_good
from tests.in_process import trackwright

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
