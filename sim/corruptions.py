"""Corruptions of ideal measurements: noise, drift, outliers, drop-outs, lost antennas and stations, late fixes.

A corruption is a function (keys, times, values, seen) -> (values, seen): one key per trajectory, times (T,) in s,
values (n, T, ...) and booleans of the same shape; the caller wraps phases after all corruptions. `corrupted` applies
several by name; each draws from the random stream of its name, so that adding one leaves the noise of the others as it
is. Of fixes (n, T, 3), m, `delayed` and `mirrored_heights` act on the true path: they belong before those that add
noise. All work in NumPy and inside a traced program, where their levels may be traced, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Bool, Float

from trackwright.sim.keys import Keys, in_dtype, namespace, normals, stream, uniforms

Times = Float[np.ndarray, " T"]
Values = Float[Any, "n T *channels"]
Seen = Bool[Any, "n T *channels"]
Constant = Float[Any, "n 1 *channels"]

Corruption = Callable[[Keys, Times, Values, Seen], tuple[Values, Seen]]
"""(keys, times, values, seen) -> (values, seen), new arrays; the arguments are not modified. As a
`jax.tree_util.Partial` its levels are numbers of the world, for gradients and for programs that worlds share."""


def corrupted(
    corruptions: Iterable[tuple[str, Corruption]], keys: Keys, times: Times, values: Values, seen: Seen
) -> tuple[Values, Seen]:
    """`values` and `seen` after all corruptions in order, each with the random stream of its name."""
    for name, corruption in corruptions:
        values, seen = corruption(stream(keys, name), times, values, seen)
    return values, seen


def added(error: Callable[..., Values], **levels: Any) -> Corruption:
    """The corruption that adds the error (keys, times, values, **levels) -> (n, T, ...) to the values."""
    return Partial(_added, Partial(error, **levels))


def _added(error: Callable[..., Values], keys: Keys, times: Times, values: Values, seen: Seen) -> tuple[Values, Seen]:
    return values + in_dtype(error(keys, times, values), values), seen


def white_noise(sigma: float) -> Corruption:
    """Independent Gaussian noise of standard deviation `sigma` on every value."""
    return added(_white, sigma=_positive("the standard deviation of white noise", sigma))


def _white(keys: Keys, times: Times, values: Values, *, sigma: float) -> Values:
    return sigma * normals(keys, values.shape[1:])


def gauss_markov(sigma: float, tau: float) -> Corruption:
    """A stationary error of every channel: standard deviation `sigma`, correlation exp(-|dt| / tau), tau in s.

    Discretised exactly: the correlation is independent of the rate, and times may be irregular.
    """
    sigma = _positive("the standard deviation of Gauss-Markov noise", sigma)
    return added(_gauss_markov, sigma=sigma, tau=_positive("the time constant of Gauss-Markov noise", tau))


def _gauss_markov(keys: Keys, times: Times, values: Values, *, sigma: float, tau: float) -> Values:
    draws, dt = in_dtype(normals(keys, values.shape[1:]), values), np.diff(times)
    xp = namespace(draws, sigma, tau)
    kept, fresh = xp.exp(-dt / tau), sigma * xp.sqrt(-xp.expm1(-2 * dt / tau))
    # Time first, trajectories last: each time is one contiguous row.
    draws = xp.moveaxis(draws, 0, -1)

    def step(before: Values, row: tuple[Any, Any, Any]) -> Values:
        return row[0] * before + row[1] * row[2]

    rows = in_dtype(kept, draws), in_dtype(fresh, draws), draws[1:]
    return xp.moveaxis(_recursion(step, sigma * draws[0], rows), -1, 0)


def _recursion(step: Callable[[Any, tuple[Any, ...]], Any], start: Any, rows: tuple[Any, ...]) -> Any:
    """The states (T, ...): `start`, then step(state, row) for each of the T − 1 rows, the same part of each array."""
    xp = namespace(start, *rows)
    if xp is np:
        states = [start]
        for row in zip(*rows, strict=True):
            states.append(step(states[-1], row))
        return np.stack(states)
    return xp.concatenate([start[None], jax.lax.scan(lambda state, row: (step(state, row),) * 2, start, rows)[1]])


def constant_bias(sigma: float) -> Corruption:
    """A constant bias of every axis, normal with standard deviation `sigma` in the unit of the values."""
    return added(_constant_bias, sigma=sigma)


def _constant_bias(keys: Keys, times: Times, values: Values, *, sigma: float) -> Constant:
    return sigma * in_dtype(normals(keys, (1, values.shape[2])), values)


def random_walk(sigma: float) -> Corruption:
    """A random-walk bias of every axis, zero at first; `sigma`: its standard deviation after 1 s."""
    return added(_random_walk, sigma=sigma)


def _random_walk(keys: Keys, times: Times, values: Values, *, sigma: float) -> Values:
    steps = np.sqrt(np.diff(times, prepend=times[:1]))[:, None]
    draws = in_dtype(normals(keys, values.shape[1:]), values)
    return sigma * namespace(draws).cumsum(steps * draws, axis=1)


def white_density(sigma: float) -> Corruption:
    """White noise of density `sigma` (unit per √Hz), independent of the sampling rate."""
    return added(_white_density, sigma=sigma)


def _white_density(keys: Keys, times: Times, values: Values, *, sigma: float) -> Values:
    dt = np.diff(times)
    roots = np.sqrt(np.concatenate([dt[:1], dt]))[:, None]
    return sigma * in_dtype(normals(keys, values.shape[1:]), values) / roots


def outliers(probability: float, size: float) -> Corruption:
    """Outliers: with `probability`, a Gaussian error of standard deviation `size` is added to a value."""
    probability = fraction("the probability of an outlier", probability)
    return added(_outliers, probability=probability, size=_positive("the size of an outlier", size))


def _outliers(keys: Keys, times: Times, values: Values, *, probability: float, size: float) -> Values:
    hit = uniforms(stream(keys, "hit"), values.shape[1:]) < probability
    # A product: it takes a seventh of the time of `where`, which branches at random.
    errors = size * normals(stream(keys, "error"), values.shape[1:])
    return in_dtype(hit, errors) * errors


def drop_outs(probability: float, mean_length_s: float = 0.0) -> Corruption:
    """Drop-outs: a share `probability` of a station's rows is missing, in bursts of mean length `mean_length_s`.

    A two-state Markov process in continuous time, stationary from the first row. At 0 s rows are independent.
    """
    return Partial(_drop_outs, bursts("the share of lost rows", probability, mean_length_s))


def _drop_outs(
    lost_when: Mapping[str, float], keys: Keys, times: Times, values: Values, seen: Seen
) -> tuple[Values, Seen]:
    lost = in_bursts(keys, times, values.shape[2], **lost_when)
    return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))


def bursts(what: str, share: float, mean_length_s: float) -> dict[str, float]:
    """The levels of `in_bursts`; raises ValueError for a share that is none."""
    length = {} if isinstance(mean_length_s, float | int) and mean_length_s <= 0 else {"mean_length_s": mean_length_s}
    return {"share": fraction(what, share), **length}


def in_bursts(
    keys: Keys, times: Times, channels: int, share: float, mean_length_s: float | None = None
) -> Bool[Any, "n T {channels}"]:
    """Bursts (n, T, channels): true for a `share` of the time, for `mean_length_s` at a stretch on average.

    A two-state Markov process in continuous time for each channel, stationary from the first row; independent in each
    row without a length.
    """
    draws = uniforms(keys, (len(times), channels))
    if mean_length_s is None:
        return draws < share
    # Bursts end at the rate 1 / length and start at p / (1 - p) of it; the correlation decays at the sum of both.
    xp, forgetting = namespace(draws, share, mean_length_s), 1 / (mean_length_s * (1 - share))
    kept, by_time = xp.exp(-np.diff(times) * forgetting), xp.moveaxis(draws, 1, 0)

    def step(lasts: Any, row: tuple[Any, Any]) -> Any:
        return row[1] < share * (1 - row[0]) + row[0] * lasts

    return xp.moveaxis(_recursion(step, by_time[0] < share, (kept, by_time[1:])), 0, 1)


def mask_antenna(station: int, antenna: int) -> Corruption:
    """An antenna without measurements. `station` and `antenna` count from 0 in the rig's order."""
    return Partial(_mask_antenna, station=station, antenna=antenna)


def _mask_antenna(
    keys: Keys, times: Times, values: Values, seen: Seen, *, station: int, antenna: int
) -> tuple[Values, Seen]:
    there = np.ones(values.shape[2:], bool)
    there[station, antenna] = False
    return values, seen & there


def lose_station(station: int, from_s: float = -np.inf, to_s: float = np.inf) -> Corruption:
    """A station without measurements from `from_s` until before `to_s`. `station` counts from 0 in the rig's order."""
    return Partial(_lose_station, station=station, from_s=from_s, to_s=to_s)


def _lose_station(
    keys: Keys, times: Times, values: Values, seen: Seen, *, station: int, from_s: float, to_s: float
) -> tuple[Values, Seen]:
    lost = ((times >= from_s) & (times < to_s))[:, None] & (np.arange(values.shape[2]) == station)
    return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))


def correlated_noise(covariance: Float[Any, "i j"]) -> Corruption:
    """White Gaussian noise with correlated axes: `covariance` (3, 3), m², symmetric and positive definite."""
    return added(_correlated, factor=namespace(covariance).linalg.cholesky(covariance))


def _correlated(keys: Keys, times: Times, values: Values, *, factor: Float[Any, "i j"]) -> Values:
    return in_dtype(normals(keys, values.shape[1:]), values) @ factor.T


def delayed(seconds: float) -> Corruption:
    """A pure delay of the fixes by `seconds`; before its first time the tag is taken to be at rest."""
    return Partial(_delayed, seconds=seconds)


def _delayed(keys: Keys, times: Times, values: Values, seen: Seen, *, seconds: float) -> tuple[Values, Seen]:
    xp, last = namespace(values, seconds), len(times) - 1
    then = xp.clip(times - seconds, times[0], times[-1])
    before = xp.clip(xp.searchsorted(times, then, side="right") - 1, 0, max(last - 1, 0))
    after, of_time = xp.minimum(before + 1, last), xp.asarray(times)
    share = (then - of_time[before]) / xp.maximum(of_time[after] - of_time[before], np.finfo(np.float32).tiny)
    return values[:, before] + share[:, None] * (values[:, after] - values[:, before]), seen


def mirrored_heights(plane: float, share: float, mean_length_s: float) -> Corruption:
    """Heights mirrored at the anchors' plane at height `plane`, m: in bursts as of `in_bursts`."""
    return Partial(_mirrored, bursts("the share of mirrored heights", share, mean_length_s), plane)


def _mirrored(
    mirrored_when: Mapping[str, float], plane: float, keys: Keys, times: Times, values: Values, seen: Seen
) -> tuple[Values, Seen]:
    flipped = in_bursts(stream(keys, "mirror"), times, 1, **mirrored_when) & (np.arange(3) == 2)
    return namespace(values, flipped).where(flipped, 2 * plane - values, values), seen


def _positive(what: str, number: float) -> float:
    """The number; raises ValueError for one, unless it is traced, that is not positive and finite."""
    if not isinstance(number, jax.core.Tracer) and not (number > 0 and np.isfinite(number)):
        raise ValueError(f"{what} is {number}: expected a positive finite number; for none, leave the corruption out")
    return number


def fraction(what: str, number: float) -> float:
    """The number; raises ValueError for one, unless it is traced, that is no share below 1."""
    if not isinstance(number, jax.core.Tracer) and not 0 <= number < 1:
        raise ValueError(f"{what} is {number}: expected 0 to below 1")
    return number
