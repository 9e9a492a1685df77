"""`trackwright simulate`."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from experiments.errors import UnusableInput
from experiments.folder import write_folder
from experiments.manifest import write_manifest
from experiments.worlds.phases import as_folder
from sim import corruptions
from sim.scenarios import simulate_phases, work_station


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
    rig = work_station()
    names = list(rig.stations)
    pieces: dict[str, corruptions.Corruption] = {}
    if gauss_markov > 0:
        pieces["gauss-markov"] = corruptions.gauss_markov(gauss_markov, 1.0)
    if outliers > 0:
        pieces["outliers"] = corruptions.outliers(outliers, np.pi)
    if drop_outs > 0:
        pieces["drop-outs"] = corruptions.drop_outs(drop_outs)
    if lost_station is not None:
        pieces["lost station"] = corruptions.lose_station(_index(names, lost_station, "lost-station"))
    if masked_antenna is not None:
        station, antenna = masked_antenna
        if not 1 <= antenna <= 8:
            raise UnusableInput(f"--masked-antenna {antenna}: expected an antenna from 1 to 8")
        pieces["masked antenna"] = corruptions.mask_antenna(_index(names, station, "masked-antenna"), antenna - 1)
    world = simulate_phases(rig, path, n, seed, rate_hz=rate_hz, n_points=rows, sigma_p=sigma_p, corruptions=pieces)
    folder = as_folder(world, f"simulated-{path}-{seed}")
    write_folder(folder, out)
    config = {"path": path, "n": n, "rows": rows, "rate_hz": rate_hz, "sigma_p": sigma_p, "corruptions": list(pieces)}
    write_manifest(out, sys.argv, config, started, seeds=(seed,))
    print(f"wrote {out}: {n} tags x {rows} rows x {len(names)} stations, with truth")
    return 0


def _index(names: list[str], name: str, option: str) -> int:
    if name not in names:
        raise UnusableInput(f"--{option} {name}: unknown station, expected one of {', '.join(names)}")
    return names.index(name)
