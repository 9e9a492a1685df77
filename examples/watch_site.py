"""Watch a site: has an anchor been moved since the baseline? Told from ranges, without truth.

python examples/watch_site.py               # an anchor is moved by 40 cm, two minutes after the start
python examples/watch_site.py BASELINE RUN  # recording folders of one site
"""

import sys
import textwrap

import matplotlib.pyplot as plt
import numpy as np

import trackwright as tw

ANCHORS = {
    "A1": (0, 0, 2.6),
    "A2": (9, 0, 0.4),
    "A3": (9, 6, 2.6),
    "A4": (0, 6, 0.4),
    "A5": (4.5, 0, 2.6),
    "A6": (4.5, 6, 0.4),
}
RIG = tw.Rig("hall", anchors={name: np.array(place, float) for name, place in ANCHORS.items()})
MOVED, BY, AT_S = "A5", np.array([0.4, 0.0, 0.0]), 120.0


def around(keys, times):
    """Through the whole hall, at a walking pace."""
    return tw.sim.hand_motion(keys, times, volume=np.array([[0.8, 0.8, 0.9], [8.2, 5.2, 1.5]]), speed=0.7)


def walk(name, seed, seconds, moved=False):
    """Five ranges a second to each anchor, with white noise and errors that last; the rig says where anchors were."""
    errors = {"lasting": tw.sim.gauss_markov(0.04, 3.0), "white": tw.sim.white_noise(0.06)}
    world = tw.sim.simulate_ranges(RIG, around, 1, seed, rate_hz=5.0, n_points=int(5 * seconds), corruptions=errors)
    if moved:
        place, path = RIG.anchors[MOVED], world.positions[0]
        longer = np.linalg.norm(path - place - BY, axis=1) - np.linalg.norm(path - place, axis=1)
        world.ranges[0, :, list(RIG.anchors).index(MOVED)] += np.where(world.times >= AT_S, longer, 0.0)
    return world.folder(name)


if len(sys.argv) > 2:
    baseline, run = tw.read(sys.argv[1]), tw.read(sys.argv[2])
else:
    baseline, run = walk("baseline", 1, 600.0), walk("today", 2, 300.0, moved=True)

watch = tw.watch(run, baseline)
print("\n".join(watch.lines()))

# Each anchor has statistics that rise while its readings fit a change better than none.
figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
ends = watch.blocks.slot + 1
of_source = np.tile(watch.site.bank.source, 2)
for k, source in enumerate(watch.site.sources):
    axes.plot(5.0 * ends, watch.course.statistic[:, of_source == k].max(axis=1), label=source.name)
axes.axhline(watch.course.threshold, color="k", linestyle="--", label="alarm")
axes.set(xlabel="time (s)", ylabel="statistic of the likeliest change", yscale="symlog", ylim=(0, None))
axes.set_title(textwrap.fill(watch.lines()[0], 90), fontsize=9)
axes.legend(ncols=2, loc="upper left")
figure.savefig("watch_site.png", dpi=100)
