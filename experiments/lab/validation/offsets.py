"""Offsets of clocks and the lever arm of an IMU, fitted by the likelihood of a tracker: simulated worlds against truth.

An IMU of 30 samples a second beside ten ranges a second that come up to 0.1 s late or early, from a tag up to 15 cm off
along each axis; angles beside ranges, up to 0.15 s late or early; and odometry beside ranges of a tag up to 30 cm off
the axle. Noise levels are about those of the worlds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import polars as pl

import trackwright as tw
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.text.terminal import progress
from trackwright.sim.imu import SAMPLES, simulate_uwb_imu
from trackwright.sim.paths import hand_motion
from trackwright.sim.ranging import WALK_VOLUME, chamber
from trackwright.trackers.core.model.rig import rotation_matrices
from trackwright.trackers.recordings.checks.imu_clock import delay_of, windows

WORLDS, RATE, RANGES = 40, 10.0, 800
COVERED = 90.0

_EXACT_RANGES = {"sensors.ranges.positive_skew": 1.0, "sensors.ranges.dof": 30.0, "sensors.ranges.bias": np.zeros(4)}
LEVELS: Mapping[str, Mapping[str, Any]] = MappingProxyType({
    "uwb-imu": {
        **_EXACT_RANGES, "motion.noise.sigma_accel": 0.03, "motion.noise.sigma_gyro": 0.003,
        "sensors.ranges.sigma_r": 0.03, "motion.noise.sigma_range_walk": 0.001,
    },
    "body": {
        **_EXACT_RANGES, "sensors.ranges.sigma_r": 0.05, "motion.place.sigma_bias": 0.01, "start.sigma_bias": 0.01,
        "start.sigma_shared": 0.01, "sensors.ranges.bias": np.zeros(8),
    },
    "fusion": {
        **_EXACT_RANGES, "sensors.ranges.sigma_r": 0.05, "sensors.bearings.sigma_azimuth": 0.05,
        "sensors.bearings.sigma_elevation": 0.05, "sensors.bearings.dof": 30.0,
        "motion.drifts.ranges.sigma_bias": 0.01, "start.sigma_bias.ranges": 0.01,
        "motion.drifts.bearings.sigma_bias": np.full(2, 0.01), "start.sigma_bias.bearings": np.full(2, 0.01),
        "start.sigma_shared": 0.01,
    },
})  # fmt: skip


def offsets(*, output: Output = DEFAULTS) -> int:
    """Offsets of clocks and lever arms by the likelihood, in simulated worlds; 1 if the intervals fail."""
    keep_programs()
    seeds = range(1, 1 + (1 if output.small else WORLDS))
    rows = list[Row]()
    with progress("worlds", 3 * len(seeds)) as advance:
        for name, world, tuned in (
            ("uwb-imu", inertial_world, ("sensors.ranges.late", "motion.arm")),
            ("fusion", fused_world, ("sensors.bearings.late",)),
            ("body", driven_world, ("motion.wheels.arm",)),
        ):
            fits = []
            for seed in seeds:
                fits.append(_fitted(name, *world(seed), tuned))
                advance(1)
            rows += _rows(name, fits)
    note = "Errors: root mean squares; interval: median half-width; check: error of the clock by `trackwright check`."
    output.publish("validation offsets", Table(rows, note=note))
    return int(not output.small and any(row["inside 95 %"] < COVERED for row in rows))


def inertial_world(seed: int) -> tuple[tw.RecordingFolder, np.ndarray]:
    """Ranges of a tag beside an IMU; by how much they are late, s, and the lever arm of the tag (3,), m, as (4,)."""
    random = np.random.default_rng([seed, 77])
    late, arm = random.uniform(-0.1, 0.1), random.uniform(-0.15, 0.15, 3)
    path = partial(hand_motion, volume=WALK_VOLUME, speed=1.0)
    folder = simulate_uwb_imu(chamber(), path, 1, seed, rate_hz=RATE, n_points=RANGES).folder(f"offset {seed}")
    moved = _from_aside(folder, arm).with_columns(pl.col("t_s") + late)
    # Up to a range between two samples of the IMU the first is held, and so late itself.
    held = late % (1.0 / (RATE * SAMPLES)) / SAMPLES
    return replace(folder, tables={"ranges": moved, "imu": folder.tables["imu"]}), np.array([late - held, *arm])


def driven_world(seed: int) -> tuple[tw.RecordingFolder, np.ndarray]:
    """Ranges of a tag on a trolley beside its odometry, and the lever arm of the tag, ahead and to the left, m (2,)."""
    arm = np.append(np.random.default_rng([seed, 79]).uniform(-0.3, 0.3, 2), 0.0)
    world = tw.simulate.body(n=1, tags=1, odometry=True, rows=600, seed=seed, bias=0.0, hidden=0.0).folder()
    tables = {"ranges": _from_aside(world, arm), "odometry": world.tables["odometry"]}
    return replace(world, tables=tables), arm[:2]


def _from_aside(folder: tw.RecordingFolder, arm: np.ndarray) -> pl.DataFrame:
    """The ranges of a tag that is at an arm (3,), m, in body axes, from where it is."""
    truth, ranges = folder.tables["truth"], folder.tables["ranges"]
    at = np.searchsorted(truth["t_s"].to_numpy(), ranges["t_s"].to_numpy() - 1e-6)
    place = truth.select("x_m", "y_m", "z_m").to_numpy()[at]
    turned = rotation_matrices(truth.select("qw", "qx", "qy", "qz").to_numpy()[at]) @ arm
    anchors = np.stack([folder.rig.anchors[anchor] for anchor in ranges["anchor"].cast(pl.String)])
    longer = np.linalg.norm(place + turned - anchors, axis=1) - np.linalg.norm(place - anchors, axis=1)
    return ranges.with_columns(pl.col("range_m") + pl.Series(longer))


def fused_world(seed: int) -> tuple[tw.RecordingFolder, np.ndarray]:
    """Ranges and angles of a tag, and by how much angles are late, s, as (1,)."""
    late = np.random.default_rng([seed, 78]).uniform(-0.15, 0.15)
    world = tw.simulate.fusion(
        n=1, rows=600, seed=seed, sigma_r=0.05, bias=0.0, hidden=0.0, sigma_angle=0.05, bias_angle=0.0
    )
    tables = world.folder().tables
    moved = tables["bearings"].with_columns(pl.col("t_s") + late)
    return replace(world.folder(), tables={"ranges": tables["ranges"], "bearings": moved}), np.array([late])


def _fitted(name: str, folder: tw.RecordingFolder, true: np.ndarray, tuned: Sequence[str]) -> Row:
    """Errors of the fitted numbers, whether the intervals hold the true ones, and half their widths."""
    began = time.process_time()
    tracker = tw.build(name, [folder]).with_values(LEVELS[name])
    fit = tw.fit(tracker, [folder], "nll", tuned, tw.FitOptions(starts=1))
    assert fit.uncertainty is not None
    intervals = fit.uncertainty.intervals()
    found, low, high = (
        np.concatenate([np.ravel(of[key]) for key in tuned])
        for of in (fit.values, *({k: ends[i] for k, ends in intervals.items()} for i in (0, 1)))
    )
    seconds = time.process_time() - began
    checked = delay_of([up for up, _ in windows(folder, folder.rows("imu").tags[0])]) if name == "uwb-imu" else None
    return {
        "error": found - true, "inside": (low <= true) & (true <= high), "half width": (high - low) / 2, "s": seconds,
        "check": np.nan if checked is None else checked + true[0],
    }  # fmt: skip


def _rows(name: str, fits: Sequence[Row]) -> list[Row]:
    """A row for each number: in ms, and in cm."""
    error, inside, half = (np.stack([fit[key] for fit in fits]) for key in ("error", "inside", "half width"))
    checked = np.array([fit["check"] for fit in fits])
    by_check = 1e3 * np.sqrt(np.nanmean(checked**2)) if np.isfinite(checked).any() else None
    late = name != "body"
    numbers = (("late, ms", 1e3),) * late + (("arm x, cm", 1e2), ("arm y, cm", 1e2), ("arm z, cm", 1e2))
    return [
        {
            "tracker": name, "number": number, "worlds": len(fits), "mean error": unit * float(error[:, k].mean()),
            "error": unit * float(np.sqrt(np.mean(error[:, k] ** 2))), "interval": unit * float(np.median(half[:, k])),
            "inside 95 %": 100.0 * float(inside[:, k].mean()), "check": None if k else by_check,
            "s": float(np.median([fit["s"] for fit in fits])),
        }
        for k, (number, unit) in enumerate(numbers[: error.shape[1]])
    ]  # fmt: skip
