"""Real recordings: our errors beside the baselines of their README. `python -m experiments.validation.recorded`.

One set of noise levels for all recordings of a kind: the trackers' defaults, or those tuned on recordings that are not
evaluated. The recordings are not part of this repository: TRACKWRIGHT_RECORDINGS, default `../shared/recordings`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.cli.subprocesses import command, figures, real_recordings
from experiments.reports.tables import aligned

OUT = Path("out/recorded")


class Run(NamedTuple):
    """Recordings of one kind to evaluate, the tracker, and the options and recordings of its tuning, if any.

    `smooth`: the tracker has a smoother; its smoothed tracks are evaluated too.
    """

    name: str
    evaluated: tuple[str, ...]
    tracker: str
    tuned_on: tuple[str, ...] = ()
    tune: tuple[str, ...] = ()
    smooth: bool = True


RUNS = (
    Run("starloc", ("starloc-fast-s1", "starloc-2d-s5"), "uwb"),
    Run("starloc-imu", ("starloc-fast-s1",), "uwb-imu"),
    Run("drones", ("iasl-drone-1", "rcv-drone-3"), "uwb"),
    Run(
        "trolley", ("lias-planar-fast",), "uwb",
        tuned_on=("lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0"),
        tune=("--objective", "rmse", "--tune", "sensors.*.bias", "--steps", "20"),
    ),
    Run("labyrinth", ("labyrinth",), "uwb"),
    Run("line", ("ngbui-line-1-1", "ngbui-line-2-1", "ngbui-line-3-1"), "line-grid", smooth=False),
    Run(
        "tiers", ("tiers-2tag-01", "tiers-2tag-03", "tiers-2tag-06"), "fix-mirror",
        tuned_on=("tiers-1tag-01",), tune=("--objective", "rmse", "--tune", "*latency*"),
    ),
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Track every kind, with smoothing where the tracker has it, and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.validation.recorded", description=(__doc__ or "").split("\n\n")[0]
    )
    names = [run.name for run in RUNS]
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(names)}; all where none is named")
    kinds = parser.parse_args(arguments).kinds
    if unknown := [name for name in kinds if name not in names]:
        parser.error(f"unknown: {', '.join(unknown)}; expected of {', '.join(names)}")
    folder = real_recordings()
    if folder is None:
        parser.error("no folder of real recordings, expected ../shared/recordings or what TRACKWRIGHT_RECORDINGS names")
    best = baselines(folder / "README.md")
    table: list[tuple[str, ...]] = []
    for run in RUNS:
        if run.name in (kinds or names):
            table += error_rows(folder, run, best)
    print("\nRMSE in m; baseline: a Kalman filter tuned on the same recording")
    head = ("recording", "tracker", "horizontal", "smoothed", "baseline", "3-D", "smoothed", "baseline")
    print(aligned([head, *table]))
    return 0


def error_rows(folder: Path, run: Run, best: dict[tuple[str, bool], float]) -> list[tuple[str, ...]]:
    """The table's rows of one kind."""
    noise: Sequence[str | Path] = ()
    if run.tuned_on:
        out = OUT / f"{run.name}-tuned"
        command("tune", *(folder / name for name in run.tuned_on), "--tracker", run.tracker, *run.tune, "--out", out)
        noise = ("--noise", out / "tuned.toml")
    paths = [folder / name for name in run.evaluated]
    command("track", *paths, "--tracker", run.tracker, *noise, "--out", OUT / run.name)
    errors = figures(OUT / run.name)["recordings"]
    smoothed: dict[str, dict[str, float]] = {}
    if run.smooth:
        out = OUT / f"{run.name}-smoothed"
        command("track", *paths, "--tracker", run.tracker, *noise, "--smooth", "--out", out)
        smoothed = {found["recording"]: found for found in figures(out)["recordings"]}
    rows: list[tuple[str, ...]] = []
    for found in errors:
        name = found["recording"]
        cells = [
            _known(x)
            for key, solid in (("rmse_m", False), ("rmse_3d_m", True))
            for x in (found[key], smoothed.get(name, {}).get(key), best.get((name, solid)))
        ]
        rows.append((name, run.tracker, *cells))
    return rows


def _known(figure: float | None) -> str:
    return "" if figure is None else f"{figure:.3f}"


def baselines(readme: Path) -> dict[tuple[str, bool], float]:
    """RMSE, m, of the tuned filter by recording and whether it is 3-D, from the tables of the recordings' README.

    The least of a recording's rows, which differ in the measurements used.
    """
    found: dict[tuple[str, bool], float] = {}
    solid = False
    for line in readme.read_text(encoding="utf-8").splitlines():
        if line.startswith("### "):
            solid = line.startswith("### 3-D")
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and (figure := re.match(r"[\d.]+", cells[7])):
            key = cells[1], solid
            found[key] = min(found.get(key, float("inf")), float(figure[0]))
    return found


if __name__ == "__main__":
    sys.exit(main())
