"""Tune noise levels by gradient on some recordings, and judge them on another.

python examples/tune_by_gradient.py                            # simulated walks
python examples/tune_by_gradient.py MY-WALK … MY-OTHER-WALK    # the last one judges
"""

import sys

import matplotlib.pyplot as plt

import trackwright as tw

if len(sys.argv) > 2:
    *walks, other = [tw.read(folder) for folder in sys.argv[1:]]
else:
    # Ranges three times as noisy as the tracker assumes, of anchors with biases.
    walks = [tw.simulate.ranges(n=4, seed=4, rows=150, sigma_r=0.25).folder()]
    other = tw.simulate.ranges(n=2, seed=5, rows=150, sigma_r=0.25).folder()

tracker = tw.build("uwb", walks[0])
for name, tunable in tw.tunables(tracker).items():
    print(f"{name:32} {tunable.unit}")

# The density of the truth under the reported positions and covariances: small errors and honest ellipses count alike.
# Without truth, "nll" is the likelihood of the readings, and gives standard errors.
levels = ("motion.sigma_a", "sensors.ranges.sigma_r")
result = tw.fit(tracker, walks, "state-nll", tune=levels, options=tw.FitOptions(steps=8))
print(result)

# Judged on a walk that the fit has not seen.
runs = {name: one.run(other) for name, one in (("default levels", tracker), ("fitted levels", result.tracker))}
for name, estimates in runs.items():
    metrics = tw.evaluate(estimates, other)
    print(f"{name}: RMSE {100 * metrics['rmse_m']:.1f} cm, {100 * metrics['coverage_95']:.0f} % in the 95 % ellipse")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
tw.plot.coverage(runs, other, ax=left)
left.set_title("closer to the diagonal is better")
tw.plot.error_cdf(runs, other, ax=right)
figure.savefig("tune_by_gradient.png", dpi=100)
