"""What every estimator is given, its model of constant velocity, and the plain filter, all without trackwright."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

Path = tuple[np.ndarray, np.ndarray | None]
"""Positions (N, d), m, and covariances (N, d, d), m², at the times of the readings."""
EPOCH_S, LEAST = 5e-3, 6  # readings no farther apart are of one state of a batch; the fewest readings of a start


@dataclass(frozen=True)
class Problem:
    """The N readings of one tag in the order of time; of fixes at a known height two channels are seen.

    `geometry` (N, g): the anchor, both anchors, or origin and axes of the station; `height`: m, NaN where it is
    estimated; `prior`: standard deviations of the start, m and m/s.
    """

    kind: str  # ranges, tdoa, bearings or fixes
    times: np.ndarray  # (N,) s
    values: np.ndarray  # (N, m), as `seen`
    seen: np.ndarray
    geometry: np.ndarray
    height: float
    prior: tuple[float, float] = (1.0, 1.0)

    @property
    def d(self) -> int:
        """Coordinates that are estimated: 2 at a known height."""
        return 3 if np.isnan(self.height) else 2

    @cached_property
    def steps(self) -> np.ndarray:
        """Seconds (N,) from the reading before each; 0 before the first."""
        return np.diff(self.times, prepend=self.times[0])

    @cached_property
    def epochs(self) -> tuple[np.ndarray, np.ndarray]:
        """The times (T,) of states, s, and the state (N,) of each reading."""
        starts: list[float] = []
        for time in self.times:
            starts += [time] if not starts or time > starts[-1] + EPOCH_S else []
        return np.array(starts), np.searchsorted(starts, self.times, "right") - 1

    @cached_property
    def beginning(self) -> tuple[np.ndarray, np.ndarray]:
        """State (2d,) and covariance before the first reading: robust least squares over the first second, at rest."""
        spans = (np.flatnonzero(self.times <= self.times[0] + s) for s in (1.0, 3.0, 10.0, np.inf))
        rows = next(r for r in spans if len(r) >= LEAST or len(r) == len(self.times))
        z, seen, geometry = self.values[rows], self.seen[rows], self.geometry[rows]
        if self.kind == "fixes":
            place = np.array([np.median(z[seen[:, k], k]) for k in range(self.d)])
        else:
            middle = np.mean(geometry[:, :3], axis=0) - [0.0, 0.0, 1.0]
            off = lambda p: (z - self.predicted(p, geometry, z))[seen]  # noqa: E731
            place = least_squares(off, middle[: self.d], loss="soft_l1", f_scale=0.3).x
        return np.append(place, np.zeros(self.d)), np.diag(np.repeat(np.square(self.prior), self.d))

    def place(self, x: Any, xp: Any = np) -> Any:
        """The place (…, 3), m, of positions or states (…, ≥ d)."""
        x = x[..., : self.d]
        return x if self.d == 3 else xp.concatenate([x, xp.full((*x.shape[:-1], 1), self.height)], axis=-1)

    def predicted(self, x: Any, geometry: Any, near: Any, xp: Any = np) -> Any:
        """The readings (…, m) expected of positions or states; angles at most π from `near`. `xp`: numpy, jax.numpy."""
        place = self.place(x, xp)
        if self.kind == "fixes":
            return place
        ray = place - geometry[..., :3]
        if self.kind == "bearings":
            u = xp.sum(geometry[..., 3:12].reshape((*geometry.shape[:-1], 3, 3)) * ray[..., None, :], axis=-1)
            flat = xp.hypot(u[..., 0], u[..., 2])
            turn = xp.stack([xp.arctan2(u[..., 0], u[..., 2]), xp.arctan2(u[..., 1], flat)], -1) - near
            return near + turn - 2 * np.pi * xp.round(turn / (2 * np.pi))
        length = xp.sqrt(xp.sum(ray * ray, axis=-1, keepdims=True))
        if self.kind == "tdoa":
            other = place - geometry[..., 3:6]
            length = length - xp.sqrt(xp.sum(other * other, axis=-1, keepdims=True))
        return length

    def off(self, x: np.ndarray, row: int) -> np.ndarray:
        """How much more the seen channels of a reading are than is expected of a state."""
        z = self.values[row]
        return (z - self.predicted(x, self.geometry[row], z))[self.seen[row]]

    def slopes(self, x: np.ndarray, row: int) -> np.ndarray:
        """The gradients (…, 2d) of the seen channels of a reading with respect to a state."""
        place, geometry, seen = self.place(x), self.geometry[row], self.seen[row]
        if self.kind == "fixes":
            return np.eye(3, 2 * self.d)[seen]
        ray = place - geometry[:3]
        full = ray[None] / np.linalg.norm(ray)
        if self.kind == "tdoa":
            full = full - (place - geometry[3:6]) / np.linalg.norm(place - geometry[3:6])
        if self.kind == "bearings":
            axes = geometry[3:12].reshape(3, 3)
            x_, y, z = np.sum(axes * ray, axis=-1)
            flat, square = np.hypot(x_, z), ray @ ray
            of_u = [[z / flat**2, 0.0, -x_ / flat**2]]
            of_u += [[-x_ * y / (flat * square), flat / square, -z * y / (flat * square)]]
            full = np.array(of_u) @ axes
        return full[seen, : self.d] @ np.eye(self.d, 2 * self.d)


def transition(d: int, dt: float) -> np.ndarray:
    """The transition (2d, 2d) of positions and velocities over dt seconds."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(d))


def diffusion(d: int, dt: float, acceleration: float) -> np.ndarray:
    """The covariance (2d, 2d) that white acceleration, m/s² per √Hz, adds over dt seconds."""
    return acceleration**2 * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(d))


def states(p: Problem, acceleration: float, reading: float) -> tuple[np.ndarray, np.ndarray]:
    """The filtered states (N, 2d) and their covariances by the textbook's extended Kalman filter.

    NumPy, one row after another, scalar updates in Joseph form.
    """
    x, P = p.beginning
    means, covariances, eye = np.empty((len(p.times), len(x))), np.empty((len(p.times), *P.shape)), np.eye(len(x))
    for row, dt in enumerate(p.steps):
        F = transition(p.d, dt)
        x, P = F @ x, F @ P @ F.T + diffusion(p.d, dt, acceleration)
        step = np.zeros(len(x))
        for off, H in zip(p.off(x, row), p.slopes(x, row), strict=True):
            gain = P @ H / (H @ P @ H + reading**2)
            step = step + gain * (off - H @ step)
            rest = eye - np.outer(gain, H)
            P = rest @ P @ rest.T + reading**2 * np.outer(gain, gain)
        x = x + step
        means[row], covariances[row] = x, P
    return means, covariances


def numpy_ekf(p: Problem, acceleration: float, reading: float) -> Path:
    """The path of `states`."""
    means, covariances = states(p, acceleration, reading)
    return means[:, : p.d], covariances[:, : p.d, : p.d]
