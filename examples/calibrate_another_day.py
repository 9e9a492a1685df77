"""Calibrate on one day, and judge on another: what a fit to the systematic errors of a site is worth.

python examples/calibrate_another_day.py                 # three simulated days
python examples/calibrate_another_day.py DAY … LAST-DAY  # recordings of one site with truth; the last one judges
"""

import sys
from dataclasses import replace

import matplotlib.pyplot as plt
import polars as pl

import trackwright as tw

BIAS = {"A1": 0.35, "A2": -0.2, "A3": 0.25, "A4": 0.1}  # m, of the antennas of this site, the same every day


def day(seed):
    """A walk through a hall whose anchors measure too long or too short."""
    folder = tw.simulate.ranges(n=1, seed=seed, rows=300, bias=0.0, sigma_r=0.05).folder()
    ranges = folder.tables["ranges"]
    long = ranges["anchor"].cast(pl.String).replace_strict(BIAS, return_dtype=pl.Float64)
    return replace(
        folder,
        name=f"day {seed}",
        tables={**folder.tables, "ranges": ranges.with_columns(range_m=ranges["range_m"] + long)},
    )


*earlier, last = [tw.read(folder) for folder in sys.argv[1:]] or [day(seed) for seed in (1, 2, 3)]

calibration = tw.calibrate(earlier)
for name, anchor in calibration.anchors.items():
    bias, slope = anchor.coefficients
    error = anchor.covariance[0, 0] ** 0.5
    true = f", true {BIAS[name]:+.2f} m" if len(sys.argv) == 1 else ""
    print(f"anchor {name}: {bias:+.3f} ± {error:.3f} m{true}, {100 * slope:+.1f} % of the distance")
for name, station in calibration.stations.items():
    print(f"station {name}: azimuth offset and gain {station.coefficients[0, :2].round(3)}")
tw.write_calibration(calibration, "calibration.toml")  # for `trackwright track --calibration calibration.toml`

# Judged on a day that the calibration has not seen: its errors are not those that were fitted.
runs = {}
for name, recording in {"as measured": last, "calibrated": last.calibrated(calibration)}.items():
    runs[name] = tw.tracker_for(recording).run(recording)
    metrics = tw.evaluate(runs[name], recording)
    print(f"{name}: RMSE {100 * metrics['rmse_m']:.0f} cm, {100 * metrics['coverage_95']:.0f} % in the 95 % ellipse")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
tw.plot.error_cdf(runs, last, ax=left)
tw.plot.coverage(runs, last, ax=right)
figure.suptitle("A day that the calibration has not seen", fontsize=10)
figure.savefig("calibrate_another_day.png", dpi=100)
