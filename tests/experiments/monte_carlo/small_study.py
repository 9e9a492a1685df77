"""A study of a few seconds, in Python and in TOML, and the command line for it."""

import json

import numpy as np

from trackwright.experiments.monte_carlo import Study, TrackerConfig, World
from trackwright.experiments.pages.study import to_json
from trackwright.sim.worlds import WORLDS

SMALL = Study(
    name="small",
    about="Does it run?",
    worlds={w: World(WORLDS["line"], {"situation": w, "rate_hz": 1.0}) for w in ("constant", "halts")},
    trackers={
        "kalman": TrackerConfig("fix-kf"),
        "window": TrackerConfig("moving-average"),
        "stiffer": TrackerConfig("fix-kf", {"motion.sigma_a": 0.2}),
    },
    runs=12,
    measures={"last_m": lambda run: np.linalg.norm((run.estimates - run.truth)[:, -1, :2], axis=-1)},
    metrics=("rmse_m", "bound_m", "last_m"),
)


TOML = """
name = "small"
runs = 12
metrics = ["rmse_m"]
[worlds.line]
rate_hz = 1.0
[trackers.fix-kf]
[trackers.moving-average]
"""


def sha(results):
    """The digest of all metrics."""
    return json.loads(to_json(results, []))["sha256"]
