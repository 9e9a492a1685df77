"""A Monte Carlo study: how does the error grow with the noise of ranges, and which tracker takes it better?

The same as a TOML file for the command line: docs/studies.md.

python examples/monte_carlo_study.py          # 40 runs of each condition
python examples/monte_carlo_study.py 1000
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import trackwright as tw
from trackwright.experiments.monte_carlo import Study, TrackerConfig, World, run_study

RUNS = int(sys.argv[1]) if len(sys.argv) > 1 else 40
NOISE = [0.05, 0.1, 0.2, 0.4]


def hall(ids, seed, sigma_r):
    """A world is a function from the ids of trajectories to a recording with truth."""
    return tw.simulate.ranges(ids=ids, seed=seed, rows=80, sigma_r=sigma_r).folder()


study = Study(
    name="noise-of-ranges",
    about="RMSE over the noise of ranges, known to the filter",
    worlds={"hall": World(hall)},
    trackers={"uwb": TrackerConfig("uwb"), "multilateration": TrackerConfig("multilateration")},
    # A number of the world, and the tracker's own, together.
    grid={"world.sigma_r, sensors.ranges.sigma_r": NOISE},
    runs=RUNS,
    metrics=["rmse_m", "coverage_95"],
)

# Finished parts are kept in the folder: the same command goes on where it was interrupted, with the same bits.
results = run_study(study, Path("noise-of-ranges"))

figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
for name in study.trackers:
    values = [results.value("rmse_m", "hall", name, **{next(iter(study.grid)): s}) for s in NOISE]
    low, middle, high = (100 * np.array([getattr(v, of) for v in values]) for of in ("low", "value", "high"))
    axes.errorbar(NOISE, middle, yerr=(middle - low, high - middle), marker="o", capsize=4, label=name)
    for sigma, at, least, most in zip(NOISE, middle, low, high, strict=True):
        print(f"{name:16} noise {sigma:4.2f} m: RMSE {at:5.1f} cm ({least:.1f} … {most:.1f})")

# All trackers see the same trajectories, so their ratio is known better than either.
ratio = results.ratio("rmse_m", "hall", "multilateration", "uwb", **{next(iter(study.grid)): NOISE[-1]})
print(
    f"at {NOISE[-1]} m multilateration errs {ratio.value:.2f} ({ratio.low:.2f} … {ratio.high:.2f}) times as much as uwb"
)

axes.set(xlabel="noise of a range (m)", ylabel="RMSE (cm), with its 95 % interval", ylim=(0, None))
axes.legend()
figure.savefig("monte_carlo_study.png", dpi=100)
