"""Survey anchors: where they are, from ranges to a tag carried about, without truth or a tape measure.

python examples/survey_anchors.py                # two simulated walks, at 0.6 m and at 1.8 m
python examples/survey_anchors.py WALK WALK …    # recording folders with ranges and tags of known height
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import polars as pl

import trackwright as tw

ANCHORS = np.array([[0, 0, 2.6], [9, 0, 0.4], [9, 6, 2.6], [0, 6, 0.4], [4.5, 0, 2.6], [4.5, 6, 0.4]], float)


def walk(height, seed, seconds=60.0):
    """Ranges of a tag that is carried around at one height: noise, a delay of each anchor, one in ten missing."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 0.25)
    frequencies, phases = rng.uniform(0.01, 0.08, (2, 4, 1)), rng.uniform(0, 2 * np.pi, (2, 4, 1))
    waves = np.sin(2 * np.pi * frequencies * times + phases).sum(axis=1)
    waves /= np.abs(waves).max(axis=1, keepdims=True)
    path = np.column_stack([4.5 + 4.0 * waves[0], 3.0 + 2.5 * waves[1], np.full(len(times), height)])
    delays = 0.3 + 0.1 * np.random.default_rng(0).normal(size=len(ANCHORS))  # the same in both walks
    ranges = np.linalg.norm(path[:, None] - ANCHORS, axis=-1) + delays + 0.05 * rng.normal(size=(len(times), 6))
    row, anchor = np.nonzero(rng.random(ranges.shape) < 0.9)
    columns = {"t_s": times[row], "tag": ["T1"] * len(row), "anchor": [f"A{k + 1}" for k in anchor]}
    table = pl.DataFrame({**columns, "range_m": ranges[row, anchor]})
    rig = tw.Rig("hall", tags={"T1": tw.Tag(height=height)})  # no anchors: those are asked for
    return tw.RecordingFolder(f"walk at {height} m", None, rig, {"ranges": table})


folders = [tw.read(folder) for folder in sys.argv[1:]] or [walk(0.6, 1), walk(1.8, 2)]

# Ranges do not say where the origin is: A1 is made the origin, A2 the x axis, and A4 stands to its left.
survey = tw.survey(folders, frame=("A1", "A2", "A4") if len(sys.argv) == 1 else ())
print(survey)

figure, axes = plt.subplots(figsize=(7.5, 4.8), layout="constrained")
for path in survey.paths:
    axes.plot(*path[:, :2].T, color="0.8", linewidth=0.8)
for k, name in enumerate(survey.names):
    block = survey.covariance[4 * k : 4 * k + 2, 4 * k : 4 * k + 2]
    sizes, directions = np.linalg.eigh(block)
    circle = np.linspace(0, 2 * np.pi, 60)
    around = directions @ (np.sqrt(5.99 * np.maximum(sizes, 0))[:, None] * np.stack([np.cos(circle), np.sin(circle)]))
    axes.plot(*(survey.positions[k, :2, None] + around), color="C0")
    words = f"{name}, z = {survey.positions[k, 2]:.2f} m\n{survey.verdict(name)}"
    axes.annotate(words, survey.positions[k, :2], (6, 6), textcoords="offset points", fontsize=8)
if len(sys.argv) == 1:
    axes.plot(*ANCHORS[:, :2].T, "k+", markersize=10, label="true")
    axes.legend(loc="lower left")
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Anchors found, 95 % ellipses, and the walks")
axes.margins(0.15)
figure.savefig("survey_anchors.png", dpi=100)
