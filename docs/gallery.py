"""Draws the pictures of docs/gallery.md (`make gallery`), and makes the pages of the program that the site shows."""

from __future__ import annotations

import contextlib
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import polars as pl
from PIL import Image

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "gallery"
COLOURS, WIDEST = 64, 1100

STUDY = """
name = "noise"
about = "RMSE over the noise of ranges"
runs = 40
metrics = ["rmse_m", "coverage_95"]
[worlds.hall]
kind = "ranges"
rows = 80
[trackers.uwb]
[trackers.multilateration]
[grid]
"world.sigma_r, sensors.ranges.sigma_r" = [0.05, 0.1, 0.2, 0.4]
"""

COMMANDS = """
simulate ranges --out hall --n 1 --rows 500
track hall --figures png --out track
study noise.toml --figures png --out study
"""

MADE = {
    "track": ("track/report.html", "track/nees-over-time.png"),
    "study": ("study/report.html", "study/rmse_m.png"),
}
"""The page of each command, and the figure that stands for it where no page can be shown."""


def pages(folder: Path) -> dict[str, str]:
    """Runs the commands in a folder; their pages by name."""
    (folder / "noise.toml").write_text(STUDY, encoding="utf-8")
    for line in COMMANDS.strip().splitlines():
        command = [sys.executable, "-m", "trackwright", *line.split()]
        there = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=folder, env=there, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"trackwright {line}: {done.stderr[-2000:]}")
    return {name: (folder / page).read_text(encoding="utf-8") for name, (page, _) in MADE.items()}


def main() -> None:
    """Draws all pictures anew."""
    mpl.use("Agg")
    with tempfile.TemporaryDirectory() as temporary, contextlib.chdir(temporary):
        folder = Path(temporary)
        for example in sorted((ROOT / "examples").glob("*.py")):
            sys.argv = [example.name]
            runpy.run_path(str(example))
            _small(folder / f"{example.stem}.png", example.stem)
        pages(folder)
        for name, (_, figure) in MADE.items():
            _small(folder / figure, name)
        generalisation(folder / "generalisation.png")
        _small(folder / "generalisation.png", "../generalisation")


def generalisation(picture: Path) -> None:
    """Draws what fits gain on a recording that they have not seen, over the number of recordings they have."""
    rows = pl.read_csv(ROOT / "docs/evidence/generalisation.csv")
    rows = rows.with_columns(pl.col("setting").str.split(",").list.first().alias("prior"))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharex=True, layout="constrained")
    for axis, (tracker, what) in zip(axes, {"bearings": "six walks", "fix-kf": "four flights"}.items(), strict=True):
        for prior, colour in (("sites", "tab:blue"), ("flat", "tab:orange")):
            found = rows.filter(pl.col("tracker") == tracker, pl.col("prior") == prior)
            axis.plot(found["recordings"], found["gain_nats"], ".", color=colour, alpha=0.5)
            mean = found.group_by("recordings").agg(pl.col("gain_nats").mean()).sort("recordings")
            axis.plot(mean["recordings"], mean["gain_nats"], "-", color=colour, label=f"--prior {prior}, mean")
        axis.axhline(0.0, color="0.6", linewidth=0.8)
        axis.set(title=f"{tracker}, {what}", xlabel="recordings fitted to", xticks=[1, 2, 3, 5])
    axes[0].set_ylabel("gain in log density\non an unseen recording [nats]")
    axes[0].legend(frameon=False)
    figure.savefig(picture, dpi=120)
    plt.close(figure)


def _small(picture: Path, name: str) -> None:
    """Keeps a picture with few pixels and colours."""
    with Image.open(picture) as image:
        image.thumbnail((WIDEST, WIDEST))
        few = image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    few.save(PICTURES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
