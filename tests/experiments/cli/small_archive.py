"""A small archive of recordings of position fixes with truth, in folders of folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, write_recording


def recording(name: str, seed: int, rows: int = 40) -> RecordingFolder:
    """A tag on a curve, with fixes whose errors grow with the seed, up to 0.3 m."""
    times, rng = 0.1 * np.arange(rows), np.random.default_rng(seed)
    truth = np.stack([3 * np.cos(0.4 * times), 2 * np.sin(0.7 * times), np.ones(rows)], axis=1)
    fixes = truth + rng.normal(0, 0.02 + 0.01 * (seed % 30), truth.shape)
    tables = {
        table: pl.DataFrame({"t_s": times, "tag": ["T"] * rows} | dict(zip(("x_m", "y_m", "z_m"), xyz.T, strict=True)))
        for table, xyz in (("fixes", fixes), ("truth", truth))
    }
    return RecordingFolder(name, None, Rig(name), tables)


def write_archive(folder: Path, count: int, rows: int = 40) -> list[Path]:
    """Write recordings `walk-00` … into a folder for each ten; their paths."""
    paths = [folder / f"day-{k // 10}" / f"walk-{k:02d}" for k in range(count)]
    for k, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_recording(recording(path.name, k, rows), path)
    return paths


def random_walk(path, seed, sigma, rows=200, truth=True):
    """Fixes of a tag that walks at random over the floor, with errors of `sigma` m, and its truth."""
    rng = np.random.default_rng(seed)
    place = np.cumsum(0.05 * rng.normal(size=(rows, 3)), axis=0) * [1, 1, 0] + [2.0, 3.0, 1.0]
    tables = {
        kind: pl.DataFrame(
            {"t_s": np.arange(rows) * 0.2, "tag": "7"} | {f"{a}_m": values[:, k] for k, a in enumerate("xyz")}
        )
        for kind, values in (("fixes", place + sigma * rng.normal(size=place.shape)), ("truth", place))
        if truth or kind == "fixes"
    }
    write_recording(RecordingFolder(path.name, None, Rig(path.name, tags={"7": Tag(1.0)}), tables), path)
    return path
