"""`trackwright simulate`."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from experiments.cli.manifest import write_manifest
from sim.worlds import station
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import write_recording


def simulate(
    out: Path,
    path: Literal["helix", "varied-helix", "hand", "lines"] = "hand",
    n: int = 100,
    seed: int = 0,
    rows: int = 200,
    rate_hz: float = 10.0,
    sigma_p: float = 0.2,
    outliers: float = 0.0,
    drop_outs: float = 0.0,
    gauss_markov: float = 0.0,
    lost_station: str | None = None,
    masked_antenna: tuple[str, int] | None = None,
) -> int:
    """Simulate beacons at the 24 GHz work station: one recording folder of many tags, with truth, in Parquet.

    Args:
        out: the folder to write; it must not exist or be empty.
        path: the paper's helix, a helix varied from tag to tag, random hand motion, or straight lines with halts.
        n: trajectories (tags).
        seed: the same seed gives the same numbers; a tag's depend on the seed and its own number alone.
        rows: measurements per trajectory.
        rate_hz: measurements per second.
        sigma_p: white phase noise, rad.
        outliers: probability that a phase is replaced by a random one.
        drop_outs: probability that a station's row is missing.
        gauss_markov: level of slowly varying phase errors, rad, with a time constant of 1 s.
        lost_station: a station (1, 2 or 3) that is silent for the whole run.
        masked_antenna: a station and an antenna (1 … 8) that is dead.
    """
    started = datetime.now(UTC)
    for name, value, low, high in (
        ("n", n, 1, 10**8),
        ("rows", rows, 1, 10**8),
        ("seed", seed, 0, 2**63 - 1),
        ("rate-hz", rate_hz, 1e-3, 1e6),
        ("sigma-p", sigma_p, 0.0, 100.0),
        ("gauss-markov", gauss_markov, 0.0, 100.0),
    ):
        if not low <= value <= high:
            raise UnusableInput(f"--{name} {value}: expected a number from {low} to {high}")
    for name, value in (("outliers", outliers), ("drop-outs", drop_outs)):
        if not 0 <= value < 1:
            raise UnusableInput(f"--{name} {value}: expected a probability from 0 to below 1")
    numbers = {
        "path": path, "rows": rows, "rate_hz": rate_hz, "sigma_p": sigma_p, "outliers": outliers,
        "drop_outs": drop_outs, "gauss_markov": gauss_markov, "lost_station": lost_station,
        "masked_antenna": masked_antenna,
    }  # fmt: skip
    try:
        folder = station(np.arange(n), seed, **numbers)  # type: ignore[arg-type]
    except ValueError as error:
        raise UnusableInput(f"--{error}") from error
    write_recording(folder, out)
    write_manifest(out, sys.argv, {"n": n, **numbers}, started, seeds=(seed,))
    print(f"wrote {out}: {n} tags x {rows} rows x {len(folder.rig.stations)} stations, with truth")
    return 0
