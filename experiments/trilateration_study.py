"""What the confidence compensation (14) of paper C does to trilateration: `python -m experiments.trilateration_study`.

Tags at a known height among the chamber's four anchors, in line of sight and with anchors hidden for a third of the
time, by trilateration with and without (14), by least squares on all four ranges, and by the filter. J of (15), whose
unit the paper leaves open, is the standard deviation of a range.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from experiments.catalogue import groups
from experiments.folder import Folder
from experiments.lanes import Lane
from experiments.tracks import batches
from experiments.worlds.ranging import simulated_ranging
from sim.corruptions import Corruption
from sim.paths import hand_motion
from sim.ranging import WALK_VOLUME, antenna_biases, chamber, obstruction, simulate_ranges
from trackers.core.estimates import Estimates

TRACKERS = ("trilateration", "trilateration-compensated", "multilateration", "uwb")
WORLDS: dict[str, dict[str, Corruption]] = {
    "line of sight": {"biases": antenna_biases(0.03)},
    "hidden for a third": {"biases": antenna_biases(0.03), "hidden": obstruction(1 / 3, 2.0, 0.2, 0.15)},
}
FLOOR = WALK_VOLUME * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.2]
SETTLED_S = 5.0
"""Seconds at the beginning that aren't judged: the filter learns its biases."""


def world(pieces: dict[str, Corruption], n: int, rows: int) -> Folder:
    """`n` tags with `rows` rows of four ranges each, ten rows a second, seed 0."""
    path = partial(hand_motion, volume=FLOOR, speed=0.5)
    return simulated_ranging(simulate_ranges(chamber(), path, n, n_points=rows, corruptions=pieces), "chamber")


def figures(folder: Folder, tracker: str) -> tuple[float, float]:
    """Horizontal RMSE and 95th percentile, m, over the last row of each time of all tags."""
    errors = []
    for group in groups([folder], tracker, False):
        for lanes, batch in batches(group.lanes):
            estimates = group.tracker.run(batch)
            errors += [judged(lane, estimates[k]) for k, lane in enumerate(lanes)]
    every = np.concatenate(errors)
    return float(np.sqrt(np.mean(every**2))), float(np.quantile(every, 0.95))


def judged(lane: Lane, estimates: Estimates) -> np.ndarray:
    """Distances, m, between the estimates of a lane's settled rows and the truth there."""
    recording = lane.recording
    rows = len(recording)
    last = np.append(np.diff(recording.times) > 0, True) & estimates.usable[:rows] & (recording.times >= SETTLED_S)
    found = np.stack([np.asarray(x)[:rows] for x in estimates.mean.position][:2], axis=1)
    return np.linalg.norm((found - recording.truth["position"][0][:, :2])[last], axis=1)


def main(n: int = 50, rows: int = 300) -> None:
    """Print the table."""
    print(f"RMSE / 95th percentile, cm, {n} tags x {rows} rows; stamps of 0.1 ns, biases of 3 cm")
    folders = {name: world(pieces, n, rows) for name, pieces in WORLDS.items()}
    print(f"{'tracker':<28}" + "".join(f"{name:>22}" for name in folders))
    for tracker in TRACKERS:
        cells = [figures(folder, tracker) for folder in folders.values()]
        print(f"{tracker:<28}" + "".join(f"{100 * a:>13.1f} / {100 * b:>6.1f}" for a, b in cells))


if __name__ == "__main__":
    main()
