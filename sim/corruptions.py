"""Corruptions of ideal measurements: noise, drift, outliers, drop-outs, lost antennas and stations, late fixes.

A corruption is a function (keys, times, values, seen) -> (values, seen): one key per trajectory, times (T,) in s,
values (n, T, ...) and booleans of the same shape; the caller wraps phases after all corruptions. `corrupted` applies
several by name; each draws from the random stream of its name, so that adding one leaves the noise of the others as it
is. Of fixes (n, T, 3), m, `delayed` and `mirrored_heights` act on the true path: they belong before those that add
noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Float

from trackwright.sim.keys import Keys, normals, stream, uniforms

Times = Float[np.ndarray, " T"]
Values = Float[np.ndarray, "n T *channels"]
Seen = Bool[np.ndarray, "n T *channels"]

Corruption = Callable[[Keys, Times, Values, Seen], tuple[Values, Seen]]
"""(keys, times, values, seen) -> (values, seen), new arrays; the arguments are not modified."""


_TIMES_AT_ONCE = 64


def corrupted(
    corruptions: Mapping[str, Corruption], keys: Keys, times: Times, values: Values, seen: Seen
) -> tuple[Values, Seen]:
    """`values` and `seen` after all corruptions in order, each with the random stream of its name."""
    for name, corruption in corruptions.items():
        values, seen = corruption(stream(keys, name), times, values, seen)
    return values, seen


def added(error: Callable[[Keys, Times, Values], Values]) -> Corruption:
    """The corruption that adds the error (keys, times, values) -> (n, T, ...) to the values."""
    return lambda keys, times, values, seen: (values + error(keys, times, values), seen)


def white_noise(sigma: float) -> Corruption:
    """Independent Gaussian noise of standard deviation `sigma` on every value."""
    _positive("the standard deviation of white noise", sigma)
    return added(lambda keys, times, values: np.float32(sigma) * normals(keys, values.shape[1:]))


def gauss_markov(sigma: float, tau: float) -> Corruption:
    """A stationary error of every channel: standard deviation `sigma`, correlation exp(-|dt| / tau), tau in s.

    Discretised exactly: the correlation is independent of the rate, and times may be irregular.
    """
    _positive("the standard deviation of Gauss-Markov noise", sigma)
    _positive("the time constant of Gauss-Markov noise", tau)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        draws, dt = normals(keys, values.shape[1:]), np.diff(times)
        kept = np.exp(-dt / tau).astype(values.dtype)
        fresh = np.append(1.0, np.sqrt(-np.expm1(-2 * dt / tau))).astype(values.dtype)
        result = np.empty_like(values)
        previous = scratch = np.empty((*values.shape[2:], len(values)), values.dtype)
        # Trajectories last, so that each time is one contiguous row, and as many times as the cache holds.
        for first in range(0, len(times), _TIMES_AT_ONCE):
            block = slice(first, first + _TIMES_AT_ONCE)
            error = np.moveaxis(draws[:, block], 0, -1).astype(values.dtype, order="C")
            error *= values.dtype.type(sigma)
            error *= fresh[block].reshape(-1, *[1] * (values.ndim - 1))
            for k, row in enumerate(error, first):
                if k > 0:
                    row += np.multiply(previous, kept[k - 1], out=scratch)
                previous = row
            np.add(values[:, block], np.moveaxis(error, -1, 0), out=result[:, block])
        return result, seen

    return corrupt


def constant_bias(sigma: float) -> Corruption:
    """A constant bias of every axis, normal with standard deviation `sigma` in the unit of the values."""
    return added(lambda keys, times, values: sigma * normals(keys, (1, values.shape[2])).astype(float))


def random_walk(sigma: float) -> Corruption:
    """A random-walk bias of every axis, zero at first; `sigma`: its standard deviation after 1 s."""

    def walk(keys: Keys, times: Times, values: Values) -> Values:
        steps = np.sqrt(np.diff(times, prepend=times[:1]))[:, None]
        return sigma * np.cumsum(steps * normals(keys, values.shape[1:]).astype(float), axis=1)

    return added(walk)


def white_density(sigma: float) -> Corruption:
    """White noise of density `sigma` (unit per √Hz), independent of the sampling rate."""

    def noise(keys: Keys, times: Times, values: Values) -> Values:
        dt = np.diff(times)
        roots = np.sqrt(np.concatenate([dt[:1], dt]))[:, None]
        return sigma * normals(keys, values.shape[1:]).astype(float) / roots

    return added(noise)


def outliers(probability: float, size: float) -> Corruption:
    """Outliers: with `probability`, a Gaussian error of standard deviation `size` is added to a value."""
    fraction("the probability of an outlier", probability)
    _positive("the size of an outlier", size)

    def error(keys: Keys, times: Times, values: Values) -> Values:
        hit = uniforms(stream(keys, "hit"), values.shape[1:]) < probability
        # A product: it takes a seventh of the time of `where`, which branches at random.
        return hit * (np.float32(size) * normals(stream(keys, "error"), values.shape[1:]))

    return added(error)


def drop_outs(probability: float, mean_length_s: float = 0.0) -> Corruption:
    """Drop-outs: a share `probability` of a station's rows is missing, in bursts of mean length `mean_length_s`.

    A two-state Markov process in continuous time, stationary from the first row. At 0 s rows are independent.
    """
    fraction("the share of lost rows", probability)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        lost = in_bursts(keys, times, values.shape[2], probability, mean_length_s)
        return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))

    return corrupt


def in_bursts(
    keys: Keys, times: Times, channels: int, share: float, mean_length_s: float
) -> Bool[np.ndarray, "n T {channels}"]:
    """Bursts (n, T, channels): true for a `share` of the time, for `mean_length_s` at a stretch on average.

    A two-state Markov process in continuous time for each channel, stationary from the first row.
    """
    draws = uniforms(keys, (len(times), channels))
    lasts = draws < share
    if mean_length_s > 0:
        # Bursts end at the rate 1 / length and start at p / (1 - p) of it; the correlation decays at the sum of both.
        forgetting = 1 / (mean_length_s * (1 - share))
        kept = np.exp(-np.diff(times) * forgetting)
        for k in range(len(kept)):
            chance = share * (1 - kept[k]) + kept[k] * lasts[:, k]
            lasts[:, k + 1] = draws[:, k + 1] < chance
    return lasts


def mask_antenna(station: int, antenna: int) -> Corruption:
    """An antenna without measurements. `station` and `antenna` count from 0 in the rig's order."""

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        seen = seen.copy()
        seen[:, :, station, antenna] = False
        return values, seen

    return corrupt


def lose_station(station: int, from_s: float = -np.inf, to_s: float = np.inf) -> Corruption:
    """A station without measurements from `from_s` until before `to_s`. `station` counts from 0 in the rig's order."""

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        seen = seen.copy()
        seen[:, (times >= from_s) & (times < to_s), station] = False
        return values, seen

    return corrupt


def correlated_noise(covariance: Float[np.ndarray, "i j"]) -> Corruption:
    """White Gaussian noise with correlated axes: `covariance` (3, 3), m², symmetric and positive definite."""
    factor = np.linalg.cholesky(np.asarray(covariance, float))
    return added(lambda keys, times, values: normals(keys, values.shape[1:]).astype(values.dtype) @ factor.T)


def delayed(seconds: float) -> Corruption:
    """A pure delay of the fixes by `seconds`; before its first time the tag is taken to be at rest."""

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        then = times - seconds
        return np.stack([np.stack([np.interp(then, times, a) for a in one.T], axis=1) for one in values]), seen

    return corrupt


def mirrored_heights(plane: float, share: float, mean_length_s: float) -> Corruption:
    """Heights mirrored at the anchors' plane at height `plane`, m: in bursts as of `in_bursts`."""
    fraction("the share of mirrored heights", share)

    def corrupt(keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
        flipped = in_bursts(stream(keys, "mirror"), times, 1, share, mean_length_s)[..., 0]
        out = values.copy()
        out[..., 2] = np.where(flipped, 2 * plane - values[..., 2], values[..., 2])
        return out, seen

    return corrupt


def _positive(what: str, number: float) -> None:
    if not (number > 0 and np.isfinite(number)):
        raise ValueError(f"{what} is {number}: expected a positive finite number; for none, leave the corruption out")


def fraction(what: str, number: float) -> None:
    """Raises ValueError for a number that is no share below 1."""
    if not 0 <= number < 1:
        raise ValueError(f"{what} is {number}: expected 0 to below 1")
