"""Corruptions of ideal measurements: noise, drift, outliers, drop-outs, lost stations, obstruction, late fixes.

A corruption is a function (keys, times, values, seen) -> (values, seen): one key per trajectory, times (T,) in s,
values (n, T, ...) and booleans of the same shape; the caller wraps phases after all corruptions. Those here are written
with their levels as further parameters: called with levels alone, as `white_noise(0.1)`, each gives the corruption.
`corrupted` applies several by name; each draws from the random stream of its name, so that adding one leaves the noise
of the others as it is. Of fixes (n, T, 3), m, `delayed` and `mirrored_heights` act on the true path: they belong before
those that add noise. All work in NumPy and inside a traced program, where their levels may be traced, too. A level out
of its range raises ValueError when it is drawn with.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, Concatenate, ParamSpec

import jax
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Bool, Float

from trackwright.sim.keys import Keys, in_dtype, namespace, normals, stream, uniforms

Times = Float[np.ndarray, " T"]
Values = Float[Any, "n T *channels"]
Seen = Bool[Any, "n T *channels"]
Corrupted = tuple[Values, Seen]

Corruption = Callable[[Keys, Times, Values, Seen], Corrupted]
"""(keys, times, values, seen) -> (values, seen), new arrays; the arguments are not modified. As a
`jax.tree_util.Partial` its levels are numbers of the world, for gradients and for programs that worlds share."""


def corrupted(
    corruptions: Mapping[str, Corruption], keys: Keys, times: Times, values: Values, seen: Seen | None = None
) -> Corrupted:
    """`values` and `seen`, by default all, after all corruptions in order, each with the random stream of its name."""
    seen = np.ones(values.shape, bool) if seen is None else seen
    for name, corruption in corruptions.items():
        values, seen = corruption(stream(keys, name), times, values, seen)
    return values, seen


P = ParamSpec("P")


def by_levels(function: Callable[Concatenate[Keys, Times, Values, Seen, P], Corrupted]) -> Callable[P, Corruption]:
    """Makes `function(keys, times, values, seen, *levels)` one of the levels alone, which gives the corruption."""
    signature = inspect.signature(function)
    levels = signature.replace(parameters=[*signature.parameters.values()][4:])

    @wraps(function)
    def of_levels(*args: P.args, **kwargs: P.kwargs) -> Corruption:
        return Partial(function, **levels.bind(*args, **kwargs).arguments)

    of_levels.of_arrays, of_levels.__signature__ = function, levels  # type: ignore[attr-defined]
    function.__qualname__ += ".of_arrays"  # where pickle finds it
    return of_levels


@by_levels
def white_noise(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float) -> Corrupted:
    """Independent Gaussian noise of standard deviation `sigma` on every value."""
    sigma = _level("the standard deviation of white noise", sigma)
    return values + in_dtype(sigma * normals(keys, values.shape[1:]), values), seen


@by_levels
def gauss_markov(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float, tau: float) -> Corrupted:
    """A stationary error of every channel: standard deviation `sigma`, correlation exp(-|dt| / tau), tau in s.

    Discretised exactly: the correlation is independent of the rate, and times may be irregular.
    """
    sigma = _level("the standard deviation of Gauss-Markov noise", sigma)
    tau = _level("the time constant of Gauss-Markov noise", tau)
    draws, dt = in_dtype(normals(keys, values.shape[1:]), values), np.diff(times)
    xp = namespace(draws, sigma, tau)
    kept, fresh = xp.exp(-dt / tau), sigma * xp.sqrt(-xp.expm1(-2 * dt / tau))
    # Time first, trajectories last: each time is one contiguous row.
    draws = xp.moveaxis(draws, 0, -1)

    def step(before: Values, row: tuple[Any, Any, Any]) -> Values:
        return row[0] * before + row[1] * row[2]

    rows = in_dtype(kept, draws), in_dtype(fresh, draws), draws[1:]
    return values + in_dtype(xp.moveaxis(_recursion(step, sigma * draws[0], rows), -1, 0), values), seen


def _recursion(step: Callable[[Any, tuple[Any, ...]], Any], start: Any, rows: tuple[Any, ...]) -> Any:
    """The states (T, ...): `start`, then step(state, row) for each of the T − 1 rows, the same part of each array."""
    xp = namespace(start, *rows)
    if xp is np:
        states = [start]
        for row in zip(*rows, strict=True):
            states.append(step(states[-1], row))
        return np.stack(states)
    return xp.concatenate([start[None], jax.lax.scan(lambda state, row: (step(state, row),) * 2, start, rows)[1]])


@by_levels
def constant_bias(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float) -> Corrupted:
    """A constant bias of every axis, normal with standard deviation `sigma` in the unit of the values."""
    return values + in_dtype(sigma * in_dtype(normals(keys, (1, values.shape[2])), values), values), seen


@by_levels
def random_walk(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float) -> Corrupted:
    """A random-walk bias of every axis, zero at first; `sigma`: its standard deviation after 1 s."""
    steps = np.sqrt(np.diff(times, prepend=times[:1]))[:, None]
    draws = in_dtype(normals(keys, values.shape[1:]), values)
    return values + in_dtype(sigma * namespace(draws).cumsum(steps * draws, axis=1), values), seen


@by_levels
def white_density(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float) -> Corrupted:
    """White noise of density `sigma` (unit per √Hz), independent of the sampling rate."""
    dt = np.diff(times)
    roots = np.sqrt(np.concatenate([dt[:1], dt]))[:, None]
    return values + in_dtype(sigma * in_dtype(normals(keys, values.shape[1:]), values) / roots, values), seen


@by_levels
def outliers(keys: Keys, times: Times, values: Values, seen: Seen, probability: float, size: float) -> Corrupted:
    """Outliers: with `probability`, a Gaussian error of standard deviation `size` is added to a value."""
    probability = _level("the probability of an outlier", probability, share=True)
    hit, size = uniforms(stream(keys, "hit"), values.shape[1:]) < probability, _level("the size of an outlier", size)
    # A product: it takes a seventh of the time of `where`, which branches at random.
    errors = size * normals(stream(keys, "error"), values.shape[1:])
    return values + in_dtype(in_dtype(hit, errors) * errors, values), seen


@by_levels
def drop_outs(
    keys: Keys, times: Times, values: Values, seen: Seen, probability: float, mean_length_s: float | None = None
) -> Corrupted:
    """Drop-outs: a share `probability` of a station's rows is missing, in bursts of mean length `mean_length_s`.

    A two-state Markov process in continuous time, stationary from the first row. Without a length rows are independent.
    """
    lost = in_bursts(keys, times, values.shape[2], probability, mean_length_s)
    return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))


def in_bursts(
    keys: Keys, times: Times, channels: int, share: float, mean_length_s: float | None = None
) -> Bool[Any, "n T {channels}"]:
    """Bursts (n, T, channels): true for a `share` of the time, for `mean_length_s` at a stretch on average.

    A two-state Markov process in continuous time for each channel, stationary from the first row; independent in each
    row without a length.
    """
    draws, share = uniforms(keys, (len(times), channels)), _level("the share of the time or of rows", share, share=True)
    if mean_length_s is None or (isinstance(mean_length_s, float | int) and mean_length_s <= 0):
        return draws < share
    # Bursts end at the rate 1 / length and start at p / (1 - p) of it; the correlation decays at the sum of both.
    xp, forgetting = namespace(draws, share, mean_length_s), 1 / (mean_length_s * (1 - share))
    kept, by_time = xp.exp(-np.diff(times) * forgetting), xp.moveaxis(draws, 1, 0)

    def step(lasts: Any, row: tuple[Any, Any]) -> Any:
        return row[1] < share * (1 - row[0]) + row[0] * lasts

    return xp.moveaxis(_recursion(step, by_time[0] < share, (kept, by_time[1:])), 0, 1)


@by_levels
def antenna_biases(keys: Keys, times: Times, values: Values, seen: Seen, sigma: float) -> Corrupted:
    """A constant bias of each anchor's ranges, m, normal with mean zero: uncalibrated antenna delays."""
    return values + in_dtype((sigma * normals(keys, values.shape[2:3]))[:, None], values), seen


@by_levels
def obstruction(
    keys: Keys, times: Times, values: Values, seen: Seen, share: float, mean_length_s: float, bias: float, tail: float
) -> Corrupted:
    """No line of sight to an anchor for a `share` of the time, `mean_length_s` at a stretch on average.

    Meanwhile its ranges are too long by `bias` m plus exponential noise of mean `tail` m.
    """
    hidden = in_bursts(stream(keys, "hidden"), times, values.shape[2], share, mean_length_s)
    draws = in_dtype(uniforms(stream(keys, "detour"), values.shape[1:]), values)
    xp = namespace(hidden, draws)
    return values + in_dtype(xp.where(hidden, bias - tail * xp.log1p(-draws), 0.0), values), seen


@by_levels
def on_anchors(
    keys: Keys, times: Times, values: Values, seen: Seen, anchors: Sequence[int], corruption: Corruption
) -> Corrupted:
    """The corruption restricted to the ranges of some anchors, which count from 0 in the rig's order."""
    chosen = list(anchors)
    parts = corruption(keys, times, values[..., chosen], seen[..., chosen])
    xp, order = namespace(*parts), [*(k for k in range(values.shape[-1]) if k not in chosen), *chosen]
    rest, place = order[: -len(chosen)], np.argsort(order)
    both = (xp.concatenate([x[..., rest], part], axis=-1) for x, part in zip((values, seen), parts, strict=True))
    values, seen = (x[..., place] for x in both)
    return values, seen


@by_levels
def round_robin(keys: Keys, times: Times, values: Values, seen: Seen) -> Corrupted:
    """Polling of the anchors in turn: one range per row instead of one to every anchor."""
    return values, seen & (np.arange(values.shape[1])[:, None] % values.shape[2] == np.arange(values.shape[2]))


@by_levels
def mask_antenna(keys: Keys, times: Times, values: Values, seen: Seen, station: int, antenna: int) -> Corrupted:
    """An antenna without measurements. `station` and `antenna` count from 0 in the rig's order."""
    there = np.ones(values.shape[2:], bool)
    there[station, antenna] = False
    return values, seen & there


@by_levels
def lose_station(
    keys: Keys, times: Times, values: Values, seen: Seen, station: int, from_s: float = -np.inf, to_s: float = np.inf
) -> Corrupted:
    """A station without measurements from `from_s` until before `to_s`. `station` counts from 0 in the rig's order."""
    lost = ((times >= from_s) & (times < to_s))[:, None] & (np.arange(values.shape[2]) == station)
    return values, seen & ~lost.reshape(lost.shape + (1,) * (values.ndim - 3))


def correlated_noise(covariance: Float[Any, "i j"]) -> Corruption:
    """White Gaussian noise with correlated axes: `covariance` (3, 3), m², symmetric and positive definite."""
    return _correlated(namespace(covariance).linalg.cholesky(covariance))


@by_levels
def _correlated(keys: Keys, times: Times, values: Values, seen: Seen, factor: Float[Any, "i j"]) -> Corrupted:
    return values + in_dtype(in_dtype(normals(keys, values.shape[1:]), values) @ factor.T, values), seen


@by_levels
def delayed(keys: Keys, times: Times, values: Values, seen: Seen, seconds: float) -> Corrupted:
    """A pure delay of the fixes by `seconds`; before its first time the tag is taken to be at rest."""
    xp, last = namespace(values, seconds), len(times) - 1
    then = xp.clip(times - seconds, times[0], times[-1])
    before = xp.clip(xp.searchsorted(times, then, side="right") - 1, 0, max(last - 1, 0))
    after, of_time = xp.minimum(before + 1, last), xp.asarray(times)
    share = (then - of_time[before]) / xp.maximum(of_time[after] - of_time[before], np.finfo(np.float32).tiny)
    return values[:, before] + share[:, None] * (values[:, after] - values[:, before]), seen


@by_levels
def mirrored_heights(
    keys: Keys, times: Times, values: Values, seen: Seen, plane: float, share: float, mean_length_s: float
) -> Corrupted:
    """Heights mirrored at the anchors' plane at height `plane`, m: in bursts as of `in_bursts`."""
    flipped = in_bursts(stream(keys, "mirror"), times, 1, share, mean_length_s) & (np.arange(3) == 2)
    return namespace(values, flipped).where(flipped, 2 * plane - values, values), seen


def _level(what: str, number: float, share: bool = False) -> float:
    """The number; raises ValueError for one, unless it is traced, that is not positive and finite, or no share."""
    if not isinstance(number, jax.core.Tracer) and not (0 <= number < 1 if share else 0 < number < np.inf):
        expected = "0 to below 1" if share else "a positive finite number; for none, leave the corruption out"
        raise ValueError(f"{what} is {number}: expected {expected}")
    return number
