"""Printed results of Huang et al. 2018, section 4, on a simulated workshop: `python -m experiments.workshop_table`.

Two measures of error: the distance to the designed route, which is what the paper can only mean, and the distance to
where the vehicle was at that time. A causal median of 9 at 10 Hz is 0.4 s late, so that the second is 20 cm at 0.5 m/s.
"""

from __future__ import annotations

from collections.abc import Iterator

import equinox as eqx
import numpy as np

from sim.agv import SimulatedFixes, simulate_agv
from trackers.baselines.fixes import fix_tracker
from trackers.baselines.windows import MovingWindow
from trackers.core.ekf import ExtendedKalman
from trackers.core.fixes import FIXES
from trackers.core.metrics import distances_to_path
from trackers.core.recording import Readings, Recording, stack
from trackers.core.tracker import AbstractTracker
from trackers.mhk.tracker import mhk_tracker

RUNS, WARM_UP = 8, 20
"""Vehicles, and the rows at the beginning that no tracker is judged on."""

PRINTED = ("as printed", 4.42, 16.0, 10.5, 98.3, 99.3, 71.6)


def trackers() -> dict[str, AbstractTracker]:
    """MH-K and what it is compared with: its median alone, itself without the chain, and a Kalman filter on fixes."""
    mhk = mhk_tracker(sigma_a=0.3)
    return {
        "median of 9": MovingWindow(9, median=True),
        "MH-K": mhk,
        "MH-K, no chain": eqx.tree_at(lambda t: t.fusion.filter, mhk, ExtendedKalman()),
        "MH-K, sticky chain": mhk_tracker(sigma_a=0.3, rate=1.0),
        "MH-K, stamped": mhk_tracker(sigma_a=0.3, stamped=True),
        "Kalman on fixes": fix_tracker(sigma_a=0.3),
    }


def errors(world: SimulatedFixes, name: str, tracker: AbstractTracker) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances to the route, to the raw fixes' distances and to the place at that time, m, over all vehicles."""
    readings = [{FIXES: Readings(f, s)} for f, s in zip(world.fixes, world.seen, strict=True)]
    height = {"height": np.full(len(world.times), world.positions[0, 0, 2])}
    recordings = [Recording(world.times, r, height, name=str(i)) for i, r in zip(world.ids, readings, strict=True)]
    estimates = tracker.run(stack(recordings))
    route, raw, in_time = [], [], []
    for k in range(len(recordings)):
        times, one = tracker.dated(world.times, estimates[k])
        place = np.stack([np.asarray(x, float) for x in one.mean.position[:2]], axis=1)[WARM_UP:]
        true = np.stack([np.interp(times[WARM_UP:], world.times, a) for a in world.positions[k, :, :2].T], axis=1)
        route.append(distances_to_path(place, world.route))
        raw.append(distances_to_path(world.fixes[k, WARM_UP:, :2], world.route))
        in_time.append(np.linalg.norm(place - true, axis=1))
    return np.concatenate(route), np.concatenate(raw), np.concatenate(in_time)


def rows() -> Iterator[tuple[str, float, float, float, float, float, float, float]]:
    """Name, then in cm and % to the route: mean, largest, variance, under 10 and 15 cm, improved; mean in time, cm."""
    world = simulate_agv(RUNS)
    for number, (name, tracker) in enumerate(trackers().items()):
        route, raw, in_time = errors(world, name, tracker)
        if number == 0:
            true = np.linalg.norm((world.fixes - world.positions)[:, WARM_UP:, :2], axis=-1)
            yield "raw fixes", *_figures(raw), np.nan, 100 * float(true.mean())
        yield name, *_figures(route), 100 * float(np.mean(route < raw)), 100 * float(in_time.mean())


def _figures(route: np.ndarray) -> tuple[float, float, float, float, float]:
    under = [100 * float(np.mean(route < limit)) for limit in (0.10, 0.15)]
    return 100 * float(route.mean()), 100 * float(route.max()), 1e4 * float(route.var()), under[0], under[1]


def main() -> None:
    """Print the table, the paper's numbers last."""
    print(f"{'':20}{'mean':>8}{'max':>8}{'var':>8}{'< 10':>8}{'< 15':>8}{'better':>8}{'in time':>9}")
    print(f"{'':20}{'cm':>8}{'cm':>8}{'cm²':>8}{'%':>8}{'%':>8}{'%':>8}{'cm':>9}")
    for name, *values in [*rows(), ("raw, as printed", 8.82, 57.89, 76.79), PRINTED]:
        print(f"{name:20}" + "".join(f"{v:8.1f}" if k < 6 else f"{v:9.1f}" for k, v in enumerate(values)))


if __name__ == "__main__":
    main()
