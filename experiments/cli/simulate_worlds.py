"""`trackwright simulate-line`, `-ranges`, `-imu` and `-agv`: the worlds beside the 24 GHz work station."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from experiments.cli.manifest import write_manifest
from sim import worlds as named
from trackers.core.errors import UnusableInput
from trackers.recordings.folder import RecordingFolder, write_recording


def simulate_line(
    out: Path,
    situation: Literal["constant", "halts", "speeds"] = "halts",
    n: int = 20,
    seed: int = 0,
    speed: float = 0.3,
    rate_hz: float = 5.0,
) -> int:
    """Simulate tags on the assembly line of known path: one recording folder with fixes, path and truth, in Parquet.

    Args:
        out: the folder to write; it must not exist or be empty.
        situation: constant speed, halts where segments meet, or another speed on every segment.
        n: trajectories (tags).
        seed: the same seed gives the same numbers; a tag's depend on the seed and its own number alone.
        speed: mean speed along the line, m/s.
        rate_hz: fixes per second.
    """
    started = datetime.now(UTC)
    _within(n=(n, 1, 10**7), seed=(seed, 0, 2**63 - 1), speed=(speed, 0.01, 10.0), rate_hz=(rate_hz, 0.1, 1000.0))
    numbers = {"situation": situation, "speed": speed, "rate_hz": rate_hz}
    return _write(named.line, numbers, out, n, seed, started)


def simulate_ranges(
    out: Path,
    n: int = 20,
    seed: int = 0,
    rows: int = 200,
    rate_hz: float = 10.0,
    sigma_r: float = 0.05,
    bias: float = 0.05,
    hidden: float = 0.1,
    lost: float = 0.1,
) -> int:
    """Simulate hand-held UWB tags in a room with four anchors: one recording folder with ranges and truth, in Parquet.

    Args:
        out: the folder to write; it must not exist or be empty.
        n: trajectories (tags).
        seed: the same seed gives the same numbers; a tag's depend on the seed and its own number alone.
        rows: times at which all anchors are ranged.
        rate_hz: times per second.
        sigma_r: white noise of a range, m.
        bias: spread of the anchors' constant biases, m.
        hidden: share of the time for which an anchor is behind an obstacle, and its ranges too long.
        lost: share of ranges that are missing.
    """
    started = datetime.now(UTC)
    _within(
        n=(n, 1, 10**7), seed=(seed, 0, 2**63 - 1), rows=(rows, 1, 10**7), rate_hz=(rate_hz, 0.1, 1000.0),
        sigma_r=(sigma_r, 0.0, 10.0), bias=(bias, 0.0, 10.0), hidden=(hidden, 0.0, 0.9), lost=(lost, 0.0, 0.99),
    )  # fmt: skip
    numbers = {"rows": rows, "rate_hz": rate_hz, "sigma_r": sigma_r, "bias": bias, "hidden": hidden, "lost": lost}
    return _write(named.ranges, numbers, out, n, seed, started)


def simulate_imu(
    out: Path,
    n: int = 20,
    seed: int = 0,
    rows: int = 800,
    rate_hz: float = 40.0,
    gap: tuple[float, float] | None = None,
) -> int:
    """Simulate hand tools with a UWB tag and an IMU: one recording folder with ranges, IMU and truth, in Parquet.

    Args:
        out: the folder to write; it must not exist or be empty.
        n: trajectories (tags).
        seed: the same seed gives the same numbers; a tag's depend on the seed and its own number alone.
        rows: ranges per tag, to one anchor after the other.
        rate_hz: ranges per second; IMU samples come three times as often.
        gap: from when to when, s, the IMU is silent.
    """
    started = datetime.now(UTC)
    _within(n=(n, 1, 10**6), seed=(seed, 0, 2**63 - 1), rows=(rows, 1, 10**7), rate_hz=(rate_hz, 1.0, 1000.0))
    if gap is not None and not 0 <= gap[0] < gap[1]:
        raise UnusableInput(f"--gap {gap[0]:g} {gap[1]:g}: expected two times in seconds, the first before the second")
    return _write(named.tool, {"rows": rows, "rate_hz": rate_hz, "gap": gap}, out, n, seed, started)


def simulate_agv(
    out: Path,
    n: int = 20,
    seed: int = 0,
    rows: int = 2000,
    speed: float = 0.5,
    wild: float = 0.0,
    latency: float = 0.0,
    mirror: float = 0.0,
) -> int:
    """Simulate vehicles round a workstation, located by UWB fixes that drift: one recording folder, in Parquet.

    Args:
        out: the folder to write; it must not exist or be empty.
        n: trajectories (tags).
        seed: the same seed gives the same numbers; a tag's depend on the seed and its own number alone.
        rows: fixes per tag, 10 a second.
        speed: m/s along the route.
        wild: probability of a wild fix.
        latency: seconds by which fixes come late.
        mirror: share of the time for which heights are mirrored at the anchors' plane.
    """
    started = datetime.now(UTC)
    _within(
        n=(n, 1, 10**7), seed=(seed, 0, 2**63 - 1), rows=(rows, 1, 10**7), speed=(speed, 0.01, 2.0),
        wild=(wild, 0.0, 0.99), latency=(latency, 0.0, 10.0), mirror=(mirror, 0.0, 0.99),
    )  # fmt: skip
    numbers = {"rows": rows, "speed": speed, "wild": wild, "latency": latency, "mirror": mirror}
    return _write(named.agv, numbers, out, n, seed, started)


def _within(**limits: tuple[float, float, float]) -> None:
    """Refuse the first option whose value is outside its limits."""
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise UnusableInput(f"--{name.replace('_', '-')} {value}: expected a number from {low:g} to {high:g}")


def _write(
    world: Callable[..., RecordingFolder], numbers: Mapping[str, Any], out: Path, n: int, seed: int, started: datetime
) -> int:
    folder = world(np.arange(n), seed, **numbers)
    write_recording(folder, out)
    write_manifest(out, sys.argv, {"n": n, **numbers}, started, seeds=(seed,))
    sizes = ", ".join(f"{name} {len(table)} rows" for name, table in folder.tables.items())
    print(f"wrote {out}: {len(folder.rig.tags)} tags, {sizes}")
    return 0
