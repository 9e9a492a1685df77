"""Recordings: the rows of one trajectory in time order, and batches of them.

A recording is checked once, on the host: sorted times, finite numbers, missing values marked by a mask, never by NaN.
Batches are batch-last, so that inside a filter step each number is one contiguous vector over trajectories.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, DTypeLike, Float, Shaped, UInt32
from numpy.typing import ArrayLike

from trackwright.trackers.core.data.frames import recording_html
from trackwright.trackers.core.errors import UnusableInput, floats, one_or_more, seconds, span
from trackwright.trackers.core.model.inputs import AnyArray, trajectory_key_data
from trackwright.trackers.core.model.sensor import Reading


@dataclass(frozen=True, eq=False)
class Readings:
    """All rows of one sensor: `values` (T, m), `seen` (T, m) bool, `reported` noise columns (T, k), k often 0.

    Its arrays are read-only views: recordings share them.
    """

    values: np.ndarray
    seen: np.ndarray
    reported: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("values", "seen") if self.reported is None else ("values", "seen", "reported"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def _reported(readings: Readings) -> np.ndarray:
    """The reported noise columns (T, k), k = 0 for none."""
    return np.zeros((len(readings.values), 0)) if readings.reported is None else readings.reported


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One trajectory's rows.

    `times`: (T,) seconds, not decreasing; time stamps in any unit become seconds since 1970. `readings`: by sensor
    name. `inputs`: by name, (T, …), known quantities that motion and sensors may use. `truth`: by quantity name, values
    (T, d) with the rows where it is known. Its arrays are read-only views. `id`: from it and the seed of a run come the
    random numbers of filters that draw any; None for the recording's position in the batch. Equal to itself alone.
    Raises UnusableInput where times are unsorted, shapes differ or a number isn't finite.
    """

    times: np.ndarray
    readings: Mapping[str, Readings]
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    truth: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    name: str = "recording"
    id: int | None = None

    def __post_init__(self) -> None:
        times = seconds(self.times)
        check_times(self.name, times)
        for name, readings in self.readings.items():
            _check_readings(f"{self.name}: readings['{name}']", readings, len(times))
        for name, values in self.inputs.items():
            _check_array(f"{self.name}: inputs['{name}']", values, len(times))
        for name, (values, known) in self.truth.items():
            _check_array(f"{self.name}: truth['{name}']", values, len(times))
            _check_array(f"{self.name}: truth['{name}'], where it is known,", known, len(times))
        object.__setattr__(self, "times", read_only(times))
        object.__setattr__(self, "inputs", {name: read_only(x) for name, x in self.inputs.items()})
        truth = {name: (read_only(values), read_only(known)) for name, (values, known) in self.truth.items()}
        object.__setattr__(self, "truth", truth)

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        sensors = ", ".join(f"{name} ({np.shape(r.values)[1]})" for name, r in self.readings.items())
        truth = f"; truth of {', '.join(self.truth)}" if self.truth else ""
        return f"<Recording '{self.name}': {len(self)} rows, {span(self.times[0], self.times[-1])}; {sensors}{truth}>"

    _repr_html_ = recording_html


class Batch(NamedTuple):
    """Recordings stacked batch-last: `dt` (T, B) s, `valid` (T, B), readings (T, m, B), inputs and truth likewise.

    `key` (2, B): random key of each trajectory, from its id and a seed. Rows beyond a recording's end
    are not valid (padding): the belief passes them bit-identical.
    """

    dt: Float[AnyArray, "T B"]
    valid: Bool[AnyArray, "T B"]
    readings: dict[str, Reading]
    inputs: Mapping[str, Float[AnyArray, "T *shape B"]]
    truth: Mapping[str, tuple[Float[AnyArray, "T d B"], Bool[AnyArray, "T B"]]]
    key: UInt32[AnyArray, "2 B"]

    @property
    def size(self) -> int:
        """The number of trajectories."""
        return int(self.dt.shape[-1])

    def rows(self, part: slice) -> Batch:
        """A slice of the time steps of all trajectories."""
        return jax.tree_util.tree_map(lambda x: x[part], self)._replace(key=self.key)

    def columns(self, start: int, stop: int) -> Batch:
        """The trajectories start … stop − 1, padded with invalid ones beyond the end of the batch."""

        def cut(x: Shaped[AnyArray, "*shape all"]) -> Shaped[np.ndarray, "*shape part"]:
            part = np.asarray(x[..., start:stop])
            missing = stop - start - part.shape[-1]
            return np.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, missing)]) if missing else part

        return jax.tree_util.tree_map(cut, self)


@dataclass(frozen=True, eq=False)
class Columns:
    """The rows of n recordings of the same sensors, inputs and truths as columns, one recording after another.

    `starts` (n + 1,): the first of the N rows of each recording, then N. `times` (N,) s, `readings`, `inputs` and
    `truth`: as in a `Recording`, with N rows. `names` and `ids` (n,). Raises UnusableInput as `Recording` does.
    """

    starts: np.ndarray
    times: np.ndarray
    readings: Mapping[str, Readings]
    inputs: Mapping[str, np.ndarray]
    truth: Mapping[str, tuple[np.ndarray, np.ndarray]]
    names: Sequence[str]
    ids: Sequence[int | None]

    def __post_init__(self) -> None:
        numbers = [self.times, *self.inputs.values(), *(x for pair in self.truth.values() for x in pair)]
        numbers += [x for r in self.readings.values() for x in (r.values, r.reported) if x is not None]
        sorted_times = np.diff(self.times) >= 0
        sorted_times[self.starts[1:-1] - 1] = True
        if not (sorted_times.all() and all(np.isfinite(x).all() for x in numbers) and np.diff(self.starts).all()):
            for k in range(len(self)):
                # The first unsuitable recording is refused with its name and row.
                self.recording(k)

    @classmethod
    def of(cls, recordings: Sequence[Recording]) -> Columns:
        """The rows of recordings; raises UnusableInput where these differ in the names or shapes of their arrays."""
        starts = np.cumsum([0, *(len(r) for r in recordings)])
        names = [r.name for r in recordings]
        return cls(starts, *_joined_rows(recordings, names), names, [r.id for r in recordings])

    @classmethod
    def joined(cls, parts: Sequence[Columns]) -> Columns:
        """The recordings of all parts; raises UnusableInput where they differ in the names or shapes of arrays."""
        starts = np.cumsum([0, *(n for part in parts for n in np.diff(part.starts))])
        names, ids = [x for part in parts for x in part.names], [x for part in parts for x in part.ids]
        return cls(starts, *_joined_rows(parts, [part.names[0] for part in parts]), names, ids)

    def chosen(self, numbers: np.ndarray) -> Columns:
        """The recordings with these numbers, in their order."""
        first, lengths = self.starts[:-1][numbers], np.diff(self.starts)[numbers]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        rows = np.arange(starts[-1]) + np.repeat(first - starts[:-1], lengths)
        names, ids = [self.names[k] for k in numbers], [self.ids[k] for k in numbers]
        return Columns(starts, self.times[rows], *each_array(self, lambda x: x[rows]), names, ids)

    def __len__(self) -> int:
        return len(self.starts) - 1

    def of_each(self, values: np.ndarray) -> np.ndarray:
        """Values per recording (n, …), repeated for each of its rows (N, …)."""
        return np.repeat(values, np.diff(self.starts), axis=0)

    def padded(self, rows: np.ndarray, width: int | None = None, missing: float = np.nan) -> np.ndarray:
        """The values of all rows (N, …) by recording (n, width, …), zero or, of floats, `missing` beyond its end.

        `width`: by default as many as the longest recording has.
        """
        lengths = np.diff(self.starts)
        width = width or int(lengths.max())
        if (lengths == width).all():
            return rows.reshape(len(self), width, *rows.shape[1:])
        missing = missing if rows.dtype.kind == "f" else 0
        padded = np.full((len(self), width, *rows.shape[1:]), missing, rows.dtype)
        padded[np.arange(width) < lengths[:, None]] = rows
        return padded

    def recording(self, number: int) -> Recording:
        """One of the recordings; its arrays are views of the columns."""
        part = slice(self.starts[number], self.starts[number + 1])
        rows = each_array(self, lambda x: x[part])
        return Recording(self.times[part], *rows, self.names[number], self.ids[number])

    def batch(
        self, rows: int | None = None, dtype: DTypeLike | None = None, seed: int = 0, truth: bool = True
    ) -> Batch:
        """The recordings as one batch; arguments as of `stack`. `truth`: whether to include it; runs do not use it."""
        dtype, lengths, size = dtype or jax.dtypes.canonicalize_dtype(float), np.diff(self.starts), len(self)
        longest = int(lengths.max())
        rows = rows or longest
        if rows < longest:
            raise UnusableInput(f"rows = {rows} is less than the longest recording's {longest}")

        def pile(array: np.ndarray, kind: DTypeLike) -> Shaped[np.ndarray, "rows *shape B"]:
            out = np.zeros((rows, *np.shape(array)[1:], size), kind)
            rows_last = np.moveaxis(self.padded(np.asarray(array), missing=0), 0, -1)
            for k in range(0, size if np.any(array) else 0, 32):  # trajectories whose rows fit the cache
                out[:longest, ..., k : k + 32] = rows_last[..., k : k + 32]
            return out

        dt = np.diff(self.times, prepend=self.times[:1])
        dt[self.starts[:-1]] = 0.0
        return Batch(
            dt=pile(dt, dtype),
            valid=np.arange(rows)[:, None] < lengths,
            readings={
                name: Reading(pile(r.values, dtype), pile(r.seen, bool), pile(_reported(r), dtype))
                for name, r in self.readings.items()
            },
            inputs={name: pile(x, dtype) for name, x in self.inputs.items()},
            truth={k: (pile(x, dtype), pile(known, bool)) for k, (x, known) in self.truth.items() if truth},
            key=trajectory_key_data(seed, [k if ident is None else ident for k, ident in enumerate(self.ids)]),
        )


def each_array(
    rows: Recording | Columns, function: Callable[[np.ndarray], np.ndarray]
) -> tuple[dict[str, Readings], dict[str, np.ndarray], dict[str, tuple[np.ndarray, np.ndarray]]]:
    """The readings, inputs and truth of rows with `function` of each of their arrays."""
    readings = {
        name: Readings(function(r.values), function(r.seen), function(_reported(r)))
        for name, r in rows.readings.items()
    }
    inputs = {name: function(x) for name, x in rows.inputs.items()}
    return readings, inputs, {name: (function(x), function(known)) for name, (x, known) in rows.truth.items()}


def _joined_rows(parts: Sequence[Recording] | Sequence[Columns], names: Sequence[str]) -> tuple[Any, Any, Any, Any]:
    """Times, readings, inputs and truth of all parts; raises UnusableInput, by the parts' names, where they differ."""
    first = parts[0]
    for other, label in zip(parts, names, strict=True):
        for what in ("readings", "inputs", "truth"):
            mine, theirs = getattr(first, what), getattr(other, what)
            if set(mine) != set(theirs):
                raise UnusableInput(
                    f"stack: '{label}' has {what} {sorted(theirs)}, '{names[0]}' {sorted(mine)}; expected the same "
                    "names in all; leave the others out, or stack these recordings separately"
                )

    def joined(arrays: Sequence[np.ndarray]) -> np.ndarray:
        shape = np.shape(arrays[0])[1:]
        for label, array in zip(names, arrays, strict=True):
            if np.shape(array)[1:] != shape:
                raise UnusableInput(f"'{label}' has rows of shape {np.shape(array)[1:]}, '{names[0]}' of {shape}")
        return np.concatenate(arrays) if len(arrays) > 1 else np.asarray(arrays[0])

    readings = {}
    for name in first.readings:
        each = [part.readings[name] for part in parts]
        arrays = ([r.values for r in each], [r.seen for r in each], [_reported(r) for r in each])
        readings[name] = Readings(*map(joined, arrays))
    truths = {name: [part.truth[name] for part in parts] for name in first.truth}
    truth = {name: (joined([x for x, _ in t]), joined([known for _, known in t])) for name, t in truths.items()}
    inputs = {name: joined([part.inputs[name] for part in parts]) for name in first.inputs}
    return joined([part.times for part in parts]), readings, inputs, truth


def stack(
    recordings: Sequence[Recording] | Any,
    rows: int | None = None,
    dtype: DTypeLike | None = None,
    seed: int = 0,
    tracker: Any = None,
) -> Batch:
    """The recordings as one batch, padded to `rows` (default: the longest), floats in `dtype` (default: jax's).

    `seed`: of the random keys, with the ids of the recordings, for filters that draw random numbers. `tracker`: by
    name, where the recordings are folders.

    All recordings have the same sensors, inputs and truths; `dt` is computed here, in float64. Raises UnusableInput for
    no recording, and where folders need several trackers.
    """
    if tracker is not None:
        recordings = [trajectory.recording for trajectory in tracker.only_batch(recordings).trajectories]
    several = one_or_more(recordings, (Recording,), "one or more recordings, as of `read(…)` with tracker=")
    return Columns.of(several).batch(rows, dtype, seed)


def check_times(name: str, times: np.ndarray) -> None:
    """Raises UnusableInput, by the recording's name, where the times (T,) of its rows are not finite or unsorted."""
    if times.ndim != 1 or len(times) == 0:
        raise UnusableInput(f"{name}: times have shape {times.shape}, expected (T,) with at least one row")
    if not np.all(np.isfinite(times)):
        raise UnusableInput(f"{name}: times[{int(np.argmin(np.isfinite(times)))}] is not finite")
    if np.any(np.diff(times) < 0):
        row = int(np.argmax(np.diff(times) < 0)) + 1
        raise UnusableInput(f"{name}: times[{row}] = {times[row]} s comes before the row above; sort the rows first")


def _check_array(what: str, array: np.ndarray, rows: int) -> None:
    array = np.asarray(array)
    length = len(array) if array.ndim else 0
    if length != rows:
        raise UnusableInput(f"{what} has {length} rows, expected {rows}, one for each time")
    bad = ~np.isfinite(array)
    if bad.any():
        row = np.argwhere(bad)[0][0]
        raise UnusableInput(f"{what} row {row} is not finite; mark what is missing by a mask")


def _check_readings(what: str, readings: Readings, rows: int) -> None:
    values, seen = np.asarray(readings.values), np.asarray(readings.seen)
    if values.ndim != 2 or len(values) != rows or seen.shape != values.shape:
        raise UnusableInput(f"{what} has values {values.shape} and seen {seen.shape}, expected ({rows}, channels) both")
    reported = _reported(readings)
    if len(reported) != rows:
        raise UnusableInput(f"{what}.reported has {len(reported)} rows, expected {rows}")
    for array in (values, reported):
        bad = ~np.isfinite(array)
        if bad.any():
            row, channel = np.argwhere(bad)[0]
            raise UnusableInput(
                f"{what} row {row}, channel {channel} is not finite; for a missing value store 0 and set seen to False"
            )


def masked(what: str, values: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """The values (rows, n), also of (rows,), with zeros for NaN, and where there was a number; raises UnusableInput."""
    values = floats(what, values)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or len(values) != rows:
        raise UnusableInput(f"{what} have shape {values.shape}; expected ({rows}, n), one row for each time")
    if np.isinf(values).any():
        raise UnusableInput(f"{what}: row {np.argwhere(np.isinf(values))[0][0]} is infinite; mark missing ones by NaN")
    seen = ~np.isnan(values)
    return np.where(seen, values, 0.0), seen


def known_rows(what: str, truth: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """True values (rows, n), zero in rows where one is NaN, and where all are known."""
    values, seen = masked(what, truth, rows)
    known = np.asarray(seen.all(axis=1))
    return np.where(known[:, None], values, 0.0), known


def variances(std: Any, values: np.ndarray) -> np.ndarray:
    """The squares of reported standard deviations, zero where there is none."""
    known = np.zeros(values.shape) if std is None else floats("std", std)
    known = known[:, None] if known.ndim == 1 < values.ndim else known
    if known.shape != values.shape:
        raise UnusableInput(f"std has shape {known.shape}; expected {values.shape}, as of the measurements")
    if (known < 0).any() or np.isinf(known).any():
        raise UnusableInput(f"std has {known[(known < 0) | np.isinf(known)][0]}; expected 0 or more, NaN for none")
    return np.nan_to_num(known) ** 2


def read_only(array: ArrayLike) -> np.ndarray:
    """A view of the array that refuses assignment."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view
