"""Right place? How often a hand tool is unlocked at the right one of nine fastening points, by their spacing.

Given that the tip is at one of the points c, all equally likely, p(c) ∝ exp(−½ (m − c)ᵀ P⁻¹ (m − c)) with estimate m
and covariance P. The tool is unlocked at the most probable point from p = 0.95 on, within half the spacing of it
(Will et al. 2020, section 2.1, print no rule). Phases of three stations and ranges with constant biases of 5 cm.

python examples/worksteps.py [RUNS]   # by default 40 of each condition, some minutes; finished parts are kept
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

from trackwright import sim
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World, run_study
from trackwright.sim.ranging import CHAMBER

RUNS = int(sys.argv[1]) if len(sys.argv) > 1 else 40
SPACINGS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
SIGMA_P, SIGMA_R, BIAS, SECONDS, WARM_UP_S, REST_M, LEVEL = 0.25, 0.03, 0.05, 10.0, 2.0, 1e-3, 0.95


def visits(keys, times, points, speed=0.3, rest_s=1.0):
    """Paths (n, T, 3), m, of random visits of `points` (K, 3), a second at rest on each, by motions of minimum jerk."""
    draws = sim.uniforms(sim.stream(keys, "round"), (int(np.ceil(np.ptp(times) / rest_s)) + 2,)).astype(float)
    # No point after itself: the index of the next one is 1 to K - 1 higher, modulo K.
    steps = np.concatenate([draws[:, :1] * len(points), 1 + draws[:, 1:] * (len(points) - 1)], axis=1).astype(int)
    stops = points[np.cumsum(steps, axis=1) % len(points)]
    motions = np.diff(stops, axis=1)
    durations = np.maximum(np.linalg.norm(motions, axis=-1) / speed, 0.25)
    starts = times[0] + np.cumsum(rest_s + durations, axis=1) - durations
    s = np.clip((times[:, None] - starts[:, None]) / durations[:, None], 0.0, 1.0)
    return stops[:, :1] + np.einsum("ntk,nkx->ntx", s**3 * (10 - 15 * s + 6 * s**2), motions)


def bench(ids, seed, spacing):
    """Rounds of the tool with phases, ranges and IMU; the table `points` holds the fastening points."""
    x, y = np.meshgrid(*[(np.arange(3) - 1) * spacing] * 2, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(9, 0.15)], axis=1)
    path = partial(visits, points=points)
    phases = sim.PhaseDraw(sim.work_station(), path, sigma_p=SIGMA_P, n_points=int(10 * SECONDS))
    errors = {"biases": sim.antenna_biases(BIAS), "white": sim.white_noise(SIGMA_R), "turn": sim.round_robin()}
    ranges = sim.RangeDraw(sim.chamber(CHAMBER - [2.5, 2.5, 1.05]), path, errors, 40.0, int(40 * SECONDS))
    of_phases, folder = (draw.drawn(ids, seed).folder("bench") for draw in (phases, sim.ImuDraw(ranges)))
    named = pl.DataFrame({"name": [str(k) for k in range(9)]} | dict(zip(("x_m", "y_m"), points[:, :2].T, strict=True)))
    tables = {**folder.tables, "phases": of_phases.tables["phases"], "points": named}
    return replace(folder, rig=replace(folder.rig, stations=of_phases.rig.stations), tables=tables)


def decided(means, covariances, points):
    """The most probable of the points (K, 2) for estimates (…, 2), and whether the tool is unlocked there."""
    away = means[..., None, :] - points
    square = (away * np.einsum("...ij,...kj->...ki", np.linalg.inv(covariances), away)).sum(axis=-1)
    weight = np.exp(-0.5 * (square - square.min(axis=-1, keepdims=True)))
    best, share = square.argmin(axis=-1), weight.max(axis=-1) / weight.sum(axis=-1)
    tolerance = 0.5 * np.linalg.norm(points[1:] - points[0], axis=1).min()
    near = np.linalg.norm(np.take_along_axis(away, best[..., None, None], axis=-2)[..., 0, :], axis=-1) <= tolerance
    return best, near & (share >= LEVEL)


def share_of(hit):
    """The mean of `hit(right, unlocked)` over the rows at rest on a point of each trajectory, NaN without any."""

    def measure(tracked):
        points = tracked.folder.tables["points"].select("x_m", "y_m").to_numpy()
        away = np.linalg.norm(tracked.truth[..., None, :2] - points, axis=-1)
        rest = tracked.known & (tracked.times >= WARM_UP_S) & (np.nan_to_num(away.min(axis=-1), nan=1.0) <= REST_M)
        spread = np.where(rest[..., None, None], tracked.covariance[..., :2, :2], np.eye(2))
        best, unlocked = decided(np.where(rest[..., None], tracked.estimates[..., :2], 0.0), spread, points)
        hits = rest & hit(best == away.argmin(axis=-1), unlocked)
        return np.where(rest.any(axis=1), hits.sum(axis=1) / np.maximum(rest.sum(axis=1), 1), np.nan)

    return measure


# Noise levels agree with this world, so that covariances can be right.
ranges = {"sensors.ranges.sigma_r": SIGMA_R, "sensors.ranges.positive_skew": 1.0, "sensors.ranges.dof": 30.0}
constant = {"motion.time_constant": 1000.0, "motion.length": 1e4, "start.sigma_shared": 1e-3, "start.sigma_bias": BIAS}
slow = {"motion.sigma_bias": BIAS, "motion.sigma_a": 0.3, "motion.memory": 5.0, "sensors.ranges.bias": [0.0] * 8}
beams = {"beams.*.sensors.*.sigma_p": SIGMA_P, "fusion.sensors.bearings.reported_std_scale": 2.0}
inertial = {"motion.noise.sigma_range_walk": 0.005, "sensors.ranges.bias": [0.0] * 4, "start.sigma_bias": BIAS}
TRACKERS = {
    "direct": TrackerConfig("direct", {"sensors.*.sigma_p": SIGMA_P, "motion.sigma_a": 0.3}, free_height=True),
    "cascade": TrackerConfig("cascade", beams, free_height=True),
    "uwb": TrackerConfig("uwb", ranges | constant | slow),
    "uwb-imu": TrackerConfig("uwb-imu", ranges | inertial, free_height=True),
}
MEASURES = {
    "named right": share_of(lambda right, unlocked: right),
    "unlocked right": share_of(lambda right, unlocked: unlocked & right),
    "unlocked wrong": share_of(lambda right, unlocked: unlocked & ~right),
}
study = Study(
    name="worksteps",
    about="How often is a hand tool unlocked at the right fastening point, by the points' spacing?",
    worlds={"bench": World(bench)},
    trackers=TRACKERS,
    runs=RUNS,
    grid={"world.spacing": SPACINGS},
    measures=MEASURES,
    metrics=(*MEASURES, "rmse_m"),
)
value = partial(run_study(study, Path("worksteps")).value, world="bench")
found = {(t, m): {s: value(m, tracker=t, **{"world.spacing": s}) for s in SPACINGS} for t in TRACKERS for m in MEASURES}
figure, panels = plt.subplots(2, 2, figsize=(7.2, 5.0), layout="constrained", sharex=True, sharey=True)
for axes, tracker in zip(panels.ravel(), TRACKERS, strict=True):
    for name in MEASURES:
        values = found[tracker, name].values()
        print(f"{tracker}: {name}", {s: f"{v.value:.0%}" for s, v in found[tracker, name].items()})
        axes.plot(SPACINGS, [v.value for v in values], label=name)
        axes.fill_between(SPACINGS, [v.low for v in values], [v.high for v in values], alpha=0.15)
    axes.set(xscale="log", title=tracker)
figure.supxlabel("spacing of the fastening points (m)")
figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
figure.savefig("worksteps.png", dpi=100)
