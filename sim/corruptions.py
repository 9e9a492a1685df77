"""What goes wrong with measured values, one piece each: noise, drift, outliers, drop-outs, a dead antenna or station.

A piece is a function (keys, times, values, seen) -> (values, seen): one key per trajectory, times (T,) in s, values
(n, T, stations, antennas) and as many booleans. White noise, Gauss-Markov noise and outliers take any (n, T, ...) and
are in the unit of the values; phases are wrapped after all pieces, by whoever calls them. The functions below make
pieces. `corrupted` gives every piece the random stream of its name, so that none changes the noise of another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from sim.keys import Keys, normals, stream, uniforms

Corruption = Callable[[Keys, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(keys, times, values, seen) -> (values, seen); makes new arrays and leaves its arguments alone."""


def corrupted(
    pieces: Mapping[str, Corruption], keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values and seen after all pieces in their order, each drawing from the stream that bears its name."""
    for name, piece in pieces.items():
        values, seen = piece(stream(keys, name), times, values, seen)
    return values, seen


def white_noise(sigma: float) -> Corruption:
    """Independent Gaussian noise of standard deviation `sigma` on every value."""
    _positive("the standard deviation of white noise", sigma)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return values + np.float32(sigma) * normals(keys, values.shape[1:]), seen

    return corrupt


def gauss_markov(sigma: float, tau: float) -> Corruption:
    """A slow error of every channel: stationary, standard deviation `sigma`, correlation exp(-|dt| / tau), tau in s.

    Discretised exactly, so that the correlation does not change with the rate and times may be irregular.
    """
    _positive("the standard deviation of Gauss-Markov noise", sigma)
    _positive("the time constant of Gauss-Markov noise", tau)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error = normals(keys, values.shape[1:]).astype(values.dtype) * values.dtype.type(sigma)
        dt = np.diff(times)
        kept = np.exp(-dt / tau).astype(values.dtype)
        fresh = np.sqrt(-np.expm1(-2 * dt / tau)).astype(values.dtype)
        for k in range(len(dt)):
            error[:, k + 1] = kept[k] * error[:, k] + fresh[k] * error[:, k + 1]
        return values + error, seen

    return corrupt


def outliers(probability: float, size: float) -> Corruption:
    """Wild values: with `probability`, each value gets a Gaussian error of standard deviation `size` on top."""
    _fraction("the probability of an outlier", probability)
    _positive("the size of an outlier", size)

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hit = uniforms(stream(keys, "hit"), values.shape[1:]) < probability
        error = np.float32(size) * normals(stream(keys, "error"), values.shape[1:])
        return values + np.where(hit, error, np.float32(0)), seen

    return corrupt


def drop_outs(probability: float, mean_length_s: float = 0.0) -> Corruption:
    """Rows in which a station reports nothing: a share `probability` of them, in bursts.

    A two-state Markov process in continuous time, stationary from the first row; bursts last `mean_length_s` on
    average. At 0 s every row is lost or not on its own.
    """
    _fraction("the share of lost rows", probability)
    if not mean_length_s >= 0:
        raise ValueError(f"the mean length of a drop-out is not negative, found {mean_length_s} s")

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lost = in_bursts(keys, times, values.shape[2], probability, mean_length_s)
        return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))

    return corrupt


def in_bursts(keys: Keys, times: np.ndarray, channels: int, share: float, mean_length_s: float) -> np.ndarray:
    """When something lasts, (n, T, channels): true for a `share` of the time, `mean_length_s` on average at a stretch.

    A two-state Markov process in continuous time for each channel, stationary from the first row.
    """
    draws = uniforms(keys, (len(times), channels))
    lasts = draws < share
    if mean_length_s > 0:
        # Ends at 1 / length, begins at p / (1 - p) of that: both together forget the state at this rate.
        forgetting = 1 / (mean_length_s * (1 - share))
        kept = np.exp(-np.diff(times) * forgetting)
        for k in range(len(kept)):
            chance = share * (1 - kept[k]) + kept[k] * lasts[:, k]
            lasts[:, k + 1] = draws[:, k + 1] < chance
    return lasts


def constant_offsets(offsets: np.ndarray) -> Corruption:
    """An array that nobody calibrated: constant offsets (antennas,) or (stations, antennas) on the values."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return values + np.asarray(offsets, values.dtype), seen

    return corrupt


def mask_antenna(station: int, antenna: int) -> Corruption:
    """A dead antenna: never seen. Station and antenna count from 0 in the rig's order."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _index("station", station, values.shape[2])
        _index("antenna", antenna, values.shape[3])
        seen = seen.copy()
        seen[:, :, station, antenna] = False
        return values, seen

    return corrupt


def lose_station(station: int, from_s: float = -np.inf, to_s: float = np.inf) -> Corruption:
    """A station that reports nothing from `from_s` until before `to_s`; it counts from 0 in the rig's order."""

    def corrupt(keys: Keys, times: np.ndarray, values: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _index("station", station, values.shape[2])
        seen = seen.copy()
        seen[:, (times >= from_s) & (times < to_s), station] = False
        return values, seen

    return corrupt


def _positive(what: str, number: float) -> None:
    if not (number > 0 and np.isfinite(number)):
        raise ValueError(f"{what} is positive and finite, found {number}; leave the piece out for none")


def _fraction(what: str, number: float) -> None:
    if not 0 <= number < 1:
        raise ValueError(f"{what} lies in 0..1, found {number}")


def _index(what: str, number: int, count: int) -> None:
    if not 0 <= number < count:
        raise ValueError(f"{what} {number} does not exist: the rig has {count}, counted from 0")
