"""`trackwright demo`: the main workflow end to end, on a simulated work station and on two real recordings."""

import json
import shutil
import time
import tomllib
from pathlib import Path

from trackwright.experiments.lab.runner import command

OUT = Path("out/demo")
REAL = Path(__file__).parent / "recordings"
SIGMA_P = 0.2  # phase noise of the simulated worlds, rad

WRONG_START = f"""# Three times the simulated phase noise.
[tunables."sensors.*.sigma_p"]
value = {3 * SIGMA_P}
unit = "rad"
"""


def demo() -> None:
    """Simulate, check, track, evaluate and tune: a tour in out/demo.

    Prints what each step shows and every command before it is run. It takes a minute, at first three; an out/demo of
    before is replaced. Two real recordings are left in out/demo/recordings to try commands on.
    """
    began = time.monotonic()
    shutil.rmtree(OUT, ignore_errors=True)
    world, short, real = OUT / "world", OUT / "short-world", OUT / "recordings"
    noise = ("--path", "hand", "--sigma-p", str(SIGMA_P))
    _say("1,000 beacons at the 24 GHz work station, simulated with truth and tracked at once")
    command("simulate", "station", *noise, "--n", "1000", "--out", world)
    command("track", world, "--tracker", "direct", "--figures", "none", "--out", OUT / "direct")

    _say(f"Noise fitted by gradient, without truth: from {3 * SIGMA_P:.1f} back to the simulated {SIGMA_P} rad")
    command("simulate", "station", *noise, "--n", "16", "--seed", "1", "--rows", "100", "--out", short)
    start = OUT / "wrong-start.toml"
    start.write_text(WRONG_START, encoding="utf-8")
    tune = ("--tune", "motion.sigma_a", "tied:sensors.*.sigma_p")
    command("tune", short, "--objective", "nll", *tune, "--noise", start, "--steps", "40", "--out", OUT / "tuned")

    shutil.copytree(REAL, real)
    _say("A real recording, three UWB tags on a trolley: is the data sound, how accurate is the default tracker?")
    command("check", real / "trolley")
    command("track", real / "trolley", "--out", OUT / "trolley")

    _say("A robot among walls: noise levels fitted to its first half, judged on its second")
    labyrinth = ("track", real / "labyrinth", "--from", "15", "--figures", "none")
    command("tune", real / "labyrinth", "--to", "15", "--out", OUT / "labyrinth")
    command(*labyrinth, "--out", OUT / "before")
    command(*labyrinth, "--noise", OUT / "labyrinth" / "tuned.toml", "--out", OUT / "after")
    command("evaluate", OUT / "before", OUT / "after", "--out", OUT / "compared")

    print(f"\nDone in {time.monotonic() - began:.0f} s.")
    print(f"  {_rmse(OUT / 'direct')} of 1,000 simulated beacons")
    tunables = tomllib.loads((OUT / "tuned" / "tuned.toml").read_text(encoding="utf-8"))["tunables"]
    fitted = next(entry for name, entry in tunables.items() if name.endswith("sigma_p"))
    print(f"  {fitted['value']:.4f} ± {fitted['standard_error']:.4f} rad of phase noise, fitted without truth")
    print(f"  {_rmse(OUT / 'trolley')} of the trolley, with default noise levels")
    print(f"Pages to look at: {OUT / 'trolley' / 'report.html'}, {OUT / 'compared' / 'comparison.html'}.")
    print(f"Recordings to try commands on: {real / 'trolley'}, {real / 'labyrinth'}.")


def _say(what: str) -> None:
    print(f"\n# {what}", flush=True)


def _rmse(tracks: Path) -> str:
    overall = json.loads((tracks / "evaluation.json").read_text(encoding="utf-8"))["overall"]
    return f"{overall['rmse_m']:.3f} m horizontal RMSE"
