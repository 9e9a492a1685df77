"""Many recordings at once, into pandas: which days were bad, and what do they have in common?

python examples/recordings_to_pandas.py            # twelve simulated days
python examples/recordings_to_pandas.py FOLDER …   # recording folders of one kind, with truth
"""

import sys

import matplotlib.pyplot as plt
import pandas as pd

import trackwright as tw

if len(sys.argv) > 1:
    recordings = tw.read_all(sys.argv[1:])
else:
    from dataclasses import replace

    # The later the day, the more often somebody stands in the way.
    days = [tw.simulate.ranges(n=2, seed=k, rows=120, hidden=0.03 * k).folder() for k in range(12)]
    recordings = [replace(folder, name=f"day {k:02d}") for k, folder in enumerate(days)]

# One call: recordings of similar length are tracked together, each with the bits that it has alone.
tracker = tw.tracker_for(recordings[0])
estimates = tracker.run(recordings)

frame = estimates.to_pandas()  # one row per tag and time
frame["nis_per_dof"] = frame["nis"] / frame["nis_dof"]
summary = frame.groupby("recording").agg(
    rows=("t_s", "size"), std_m=("std_x_m", "median"), nis_per_dof=("nis_per_dof", "mean")
)
metrics = pd.DataFrame(tw.evaluate(estimates, recordings).tracks)  # one row per track, one column per metric
by_day = metrics.groupby("recording")[["rmse_m", "p95_m", "coverage_95"]].mean()
summary = summary.join(by_day)
print(summary.round(3).to_string())
print(f"RMSE and NIS: rank correlation {summary['rmse_m'].corr(summary['nis_per_dof'], method='spearman'):.2f}")
summary.to_csv("days.csv")

errors = pd.Series(summary["rmse_m"] * 100, name="RMSE (cm)")
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
errors.plot.bar(ax=left, ylabel="RMSE (cm)", xlabel="")
right.scatter(summary["nis_per_dof"], errors)
for name, row in summary.iterrows():
    right.annotate(
        str(name).removeprefix("day "),
        (row["nis_per_dof"], 100 * row["rmse_m"]),
        (4, 3),
        textcoords="offset points",
        fontsize=8,
    )
right.set(xlabel="NIS per degree of freedom, known without truth", ylabel="RMSE (cm)")
figure.savefig("recordings_to_pandas.png", dpi=100)
