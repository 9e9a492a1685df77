"""`trackwright demo`: the main workflow end to end on a simulated work station."""

import json
import shutil
import time
import tomllib
from pathlib import Path

from trackwright.experiments.lab.runner import command, recordings_folder

OUT = Path("out/demo")
SIGMA_P = 0.2
"""Phase noise of the simulated worlds, rad."""

WALK = "ble51-walk-u2-r2"
WRONG_START = f"""# Three times the simulated phase noise.
[tunables."sensors.*.sigma_p"]
value = {3 * SIGMA_P}
unit = "rad"
"""


def demo() -> None:
    """Simulate, check, track, evaluate and tune: a tour in out/demo.

    Prints every command before it is run, and a summary. It takes some minutes; an out/demo of before is replaced.
    """
    began = time.monotonic()
    shutil.rmtree(OUT, ignore_errors=True)
    world, short = OUT / "world", OUT / "short-world"
    noise = ("--path", "hand", "--sigma-p", str(SIGMA_P))
    command("simulate", "station", *noise, "--n", "1000", "--out", world)
    command("check", world)
    command("track", world, "--tracker", "direct", "--out", OUT / "direct")
    command("track", world, "--tracker", "cascade", "--out", OUT / "cascade")

    command("simulate", "station", *noise, "--n", "16", "--seed", "1", "--rows", "100", "--out", short)
    start = OUT / "wrong-start.toml"
    start.write_text(WRONG_START, encoding="utf-8")
    tune = ("--tune", "motion.sigma_a", "tied:sensors.*.sigma_p")
    command("tune", short, "--objective", "nll", *tune, "--noise", start, "--steps", "40", "--out", OUT / "tuned")

    recordings = recordings_folder()
    walk = None if recordings is None or not (recordings / WALK).is_dir() else recordings / WALK
    if walk is not None:
        command("track", walk, "--out", OUT / "walk")

    print(f"\nDone in {time.monotonic() - began:.0f} s. 1,000 simulated tags at the work station, 200 rows each:")
    for name in ("direct", "cascade"):
        print(f"  {_line(OUT / name)}")
    tunables = tomllib.loads((OUT / "tuned" / "tuned.toml").read_text(encoding="utf-8"))["tunables"]
    fitted = next(entry for name, entry in tunables.items() if name.endswith("sigma_p"))
    print(f"Phase noise of {SIGMA_P} rad, started from {3 * SIGMA_P:.1f} and fitted without truth, all stations tied:")
    print(f"  {fitted['value']:.4f} ± {fitted['standard_error']:.4f} rad   {OUT / 'tuned'}")
    print(f"A page to look at first: {OUT / 'direct' / 'report.html'}.")
    if walk is None:
        print(f"A recorded walk is left out: no recording {WALK} in the folder of TRACKWRIGHT_RECORDINGS.")
    else:
        print(f"A recorded walk ({WALK}) with default noise levels, which were set on other walks:")
        print(f"  {_line(OUT / 'walk', covariances=True)}")


def _line(tracks: Path, covariances: bool = False) -> str:
    from trackwright.experiments.text.wording import shown_metric
    from trackwright.trackers.evaluation.statements import covariance_statements

    overall = json.loads((tracks / "evaluation.json").read_text(encoding="utf-8"))["overall"]
    spatial = shown_metric(overall, "rmse_3d_m")
    in_space = "" if spatial is None else f", {spatial:.3f} m 3-D"
    line = f"{overall['rmse_m']:.3f} m horizontal{in_space} RMSE   {tracks}"
    if not covariances:
        return line
    return "\n  ".join([line, *covariance_statements(overall, [])])
