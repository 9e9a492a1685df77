"""Errors beside the posterior Cramér–Rao bound in worlds of a tracker's own model with normal noise, and consistency.

At half, once and twice the levels of noise and biases. Starts are near the truth, about which readings are linear, and
rows count from `SETTLED` on, when they are forgotten.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from functools import partial
from typing import Any

import jax
import numpy as np
from trackwright.experiments.lab.verify.worlds import NEVER_LOST

import trackwright as tw
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.validation.own_worlds import own_world
from trackwright.sim import SimulatedWorld, worlds
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import tunables
from trackwright.trackers.evaluation.bounds import posterior_bound

TAGS, SETTLED = 32, 80
"""Trajectories, and rows until the start is forgotten."""

LEVELS = (0.5, 1.0, 2.0)

WORLDS: Mapping[str, Callable[..., SimulatedWorld]] = {
    "uwb": partial(worlds.ranges, rows=60, lost=0.0, hidden=0.0),
    "tdoa": partial(worlds.tdoa, rows=240, schedule="turns", lost=0.0, hidden=0.0),
    "fusion": partial(worlds.fusion, rows=60, lost=0.0, hidden=0.0),
    "body": partial(worlds.body, rows=40, lost=0.0, hidden=0.0),
    "body with odometry": partial(worlds.body, rows=40, odometry=True, lost=0.0, hidden=0.0),
    "body of one tag with odometry": partial(worlds.body, rows=120, tags=1, odometry=True, lost=0.0, hidden=0.0),
}
"""The worlds of each tracker, which the first word names."""

NORMAL = {"sensors.*.dof": 1e4, "sensors.*.positive_skew": 1.0, "motion.*length": 1e30}
"""Numbers with which noise is normal and additive, as the bound asks."""

NEAR = {"start.sigma_position": 0.15, "start.sigma_velocity": 0.3, "start.sigma_heading": 0.15}


def figures(name: str, noise: float) -> dict[str, float]:
    """RMSE over bound of position and heading, NEES/dof and share inside 95 % over the floor.

    `noise`: by what factor the levels of sensors, biases and wheels differ from the defaults.
    """
    folder = WORLDS[name](n=TAGS, seed=5).folder()
    batch = tw.TRACKERS[name.partition(" ")[0]].batches([folder], name)[0]
    tracker = batch.tracker
    assert isinstance(tracker, tw.Tracker)
    scaled = ("sensors.*.sigma_*", "*.sigma_bias", "motion.wheels.*")
    levels = {
        key: noise * np.asarray(node.value)
        for key, node in tunables(tracker).items()
        if any(fnmatch(key, pattern) for pattern in scaled)
    }
    fixed = {key: v for p, v in (NORMAL | NEAR).items() for key in tunables(tracker) if fnmatch(key, p)}
    tracker = dataclasses.replace(tracker, track_loss=NEVER_LOST).with_values(levels | fixed)
    mine = [t for t in batch.trajectories if t.tag.isdecimal()]
    drawn, priors, states = own_world(tracker, [_placed(t.recording) for t in mine], 1)
    estimates = tracker.run(drawn, initial=priors)
    paths = [jax.tree_util.tree_map(lambda x, k=k: x[..., k : k + 1], states) for k in range(len(drawn))]
    # Of each path by itself: the mean information of paths that pass a station at other distances is of none of them.
    bounds = np.stack([posterior_bound(tracker, stack([r]), path) for r, path in zip(drawn, paths, strict=True)])
    errors = _position(estimates.mean.position) - _position(states.position).swapaxes(0, 1)
    errors, bounds = errors[:, SETTLED:], bounds[:, SETTLED:]
    n = errors.shape[2]
    covariance = np.asarray(estimates.covariance)[:, SETTLED:, :2, :2]
    nees = np.einsum("btk,btkl,btl->bt", errors[..., :2], np.linalg.inv(covariance), errors[..., :2])
    found = {
        "position": _over(errors, bounds[..., :n]),
        "nees": float(nees.mean() / 2),
        "inside": float(np.mean(nees < -2.0 * np.log(0.05))),
    }
    if hasattr(states, "attitude"):
        turned = np.asarray(estimates.mean.attitude.angle) - np.asarray(states.attitude.angle).T
        turned = np.pi - (np.pi - turned[:, SETTLED:]) % (2 * np.pi)
        names = component_names(jax.tree_util.tree_map(lambda x: x[0, 0], states))
        found["heading"] = _over(turned, bounds[..., names.index("attitude.0")])
    return found


def _placed(recording: Recording) -> Recording:
    """The recording with a position of the start in its first row, too, where one range determines none."""
    nearby = recording.inputs["nearby"].copy()
    nearby[0] = nearby[int(np.argmax(nearby[:, 3] > 0.5))]
    return dataclasses.replace(recording, inputs={**recording.inputs, "nearby": nearby})


def _position(position: Any) -> np.ndarray:
    return np.stack([np.asarray(x, float) for x in position], axis=-1)


def _over(errors: np.ndarray, bounds: np.ndarray) -> float:
    """The RMSE over the root mean square of the bounds."""
    return float(np.sqrt(np.mean(errors**2) / np.mean(bounds**2)))


def error_over_bound(*trackers: str, output: Output = DEFAULTS) -> int:
    """Errors over the Cramér–Rao bound in worlds of each tracker's own model, at three levels of noise.

    Args:
        trackers: `uwb`, `tdoa`, `fusion`, `body`, or a world of them; all where none is named.
    """
    names = chosen(trackers, WORLDS)
    output.publish("validation error-over-bound", Table(shown(_row(n, level) for n in names for level in LEVELS)))
    return 0


def _row(name: str, level: float) -> Row:
    found = figures(name, level)
    tracker, _, world = name.partition(" ")
    return {
        "tracker": f"`{tracker}` {world}".strip(),
        "levels": f"× {level:g}",
        "position, RMSE / bound": f"{found['position']:.2f}",
        "heading": f"{found['heading']:.2f}" if "heading" in found else "",
        "NEES/dof": f"{found['nees']:.2f}",
        "inside 95 %": f"{100 * found['inside']:.0f} %",
    }
