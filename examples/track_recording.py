"""Track a recording, and read the ellipses: where the tag was, and how well that is known.

python examples/track_recording.py            # a simulated hall
python examples/track_recording.py MY-FOLDER  # a recording folder with anchors and ranges, say
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import trackwright as tw

if len(sys.argv) > 1:
    recording = tw.read(sys.argv[1])
else:
    recording = tw.simulate.ranges(n=1, seed=3, rows=400, sigma_r=0.1).folder()

# Wrong units, swapped anchors and clocks that differ are named before anything is tracked.
problems = [f"{result.level}: {result.message}" for result in tw.check(recording) if result.level != "info"]
print("\n".join(problems) or "check found nothing to mend")

tracker = tw.tracker_for(recording)  # chosen by the tables of the recording
estimates = tracker.run(recording)
print(tracker, estimates, sep="\n")

# An estimate is a position and a covariance: the half axes of the ellipse that holds the truth with 95 % probability.
table = estimates.to_polars().drop_nulls("x_m")
last = table.row(-1, named=True)
covariance = np.array([[last["std_x_m"] ** 2, last["cov_xy_m2"]], [last["cov_xy_m2"], last["std_y_m"] ** 2]])
CHI_SQUARE = -2 * np.log(1 - 0.95)  # the 95 % quantile with two degrees of freedom
half_axes = np.sqrt(CHI_SQUARE * np.linalg.eigvalsh(covariance))
print(f"at {last['t_s']:.1f} s: ({last['x_m']:.2f}, {last['y_m']:.2f}) m, half axes {half_axes.round(2)} m")

# Whether that is true is seen where a truth is known: as many rows as stated, or more, have it inside.
metrics = tw.evaluate(estimates, recording)
print(f"horizontal RMSE {100 * metrics['rmse_m']:.0f} cm")
print(f"the 95 % ellipse holds the truth in {100 * metrics['coverage_95']:.0f} % of {len(table)} rows")

figure, (plan, errors) = plt.subplots(1, 2, figsize=(11, 4), width_ratios=(1, 1.2), layout="constrained")
tw.plot.floor_plan(estimates, recording, ax=plan)
tw.plot.error_over_time(estimates, recording, ax=errors)
figure.savefig("track_recording.png", dpi=100)
tw.plot.playback(estimates, recording).save("track_recording.html")  # the same with a time slider, in a browser
