"""Recordings: the rows of one trajectory in time order, and batches of them.

A recording is checked once, on the host: sorted times, finite numbers, missing values marked by a mask, never by NaN.
Batches are batch-last, so that inside a filter step each number is one contiguous vector over trajectories.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, DTypeLike, Float, Shaped, UInt32
from numpy.typing import ArrayLike

from trackers.core.algebra import Scalar
from trackers.core.inputs import AnyArray, Inputs
from trackers.core.keys import trajectory_key_data
from trackers.core.sensor import Reading


@dataclass(frozen=True)
class Readings:
    """All rows of one sensor: `values` (T, m), `seen` (T, m) bool, `reported` noise columns (T, k), k often 0.

    Its arrays are read-only views: recordings share them.
    """

    values: np.ndarray
    seen: np.ndarray
    reported: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name in ("values", "seen") if self.reported is None else ("values", "seen", "reported"):
            object.__setattr__(self, name, _read_only(getattr(self, name)))


def _read_only(array: ArrayLike) -> np.ndarray:
    """A view of the array that refuses assignment."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, repr=False)
class Recording:
    """One trajectory's rows.

    `times`: (T,) seconds, float64, not decreasing. `readings`: by sensor name. `inputs`: by name, (T, …), known
    quantities that motion and sensors may use. `truth`: by quantity name, values (T, d) with the rows where it is
    known. Its arrays are read-only views. `id`: from it and the seed of a run come the random numbers of filters that
    draw any; None for the recording's place among those that run together. Raises ValueError where times are unsorted,
    shapes differ or a number isn't finite.
    """

    times: np.ndarray
    readings: Mapping[str, Readings]
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    truth: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    name: str = "recording"
    id: int | None = None

    def __post_init__(self) -> None:
        times = np.asarray(self.times, np.float64)
        if times.ndim != 1 or len(times) == 0:
            raise ValueError(f"{self.name}: times have shape {times.shape}, expected (T,) with at least one row")
        if not np.all(np.isfinite(times)):
            raise ValueError(f"{self.name}: times[{int(np.argmin(np.isfinite(times)))}] is not finite")
        if np.any(np.diff(times) < 0):
            row = int(np.argmax(np.diff(times) < 0)) + 1
            raise ValueError(
                f"{self.name}: times[{row}] = {times[row]} s comes before the row above; sort the rows first"
            )
        for name, readings in self.readings.items():
            self._check(name, readings)
        for name, values in self.inputs.items():
            self._check_rows(f"inputs['{name}']", values)
        for name, (values, known) in self.truth.items():
            self._check_rows(f"truth['{name}']", values)
            self._check_rows(f"truth['{name}'], where it is known,", known)
        object.__setattr__(self, "times", _read_only(times))
        object.__setattr__(self, "inputs", {name: _read_only(x) for name, x in self.inputs.items()})
        truth = {name: (_read_only(values), _read_only(known)) for name, (values, known) in self.truth.items()}
        object.__setattr__(self, "truth", truth)

    def _check_rows(self, what: str, array: np.ndarray) -> None:
        array = np.asarray(array)
        rows = len(array) if array.ndim else 0
        if rows != len(self.times):
            raise ValueError(f"{self.name}: {what} has {rows} rows, expected {len(self.times)}, one for each time")
        bad = ~np.isfinite(array)
        if bad.any():
            row = np.argwhere(bad)[0][0]
            raise ValueError(f"{self.name}: {what} row {row} is not finite; mark what is missing by a mask")

    def _check(self, name: str, readings: Readings) -> None:
        values, seen = np.asarray(readings.values), np.asarray(readings.seen)
        rows = len(self.times)
        if values.ndim != 2 or len(values) != rows or seen.shape != values.shape:
            raise ValueError(
                f"{self.name}: readings['{name}'] has values {values.shape} and seen {seen.shape}, "
                f"expected ({rows}, channels) both"
            )
        extra = () if readings.reported is None else (readings.reported,)
        if readings.reported is not None and len(readings.reported) != rows:
            raise ValueError(
                f"{self.name}: readings['{name}'].reported has {len(readings.reported)} rows, expected {rows}"
            )
        for array in (values, *extra):
            bad = ~np.isfinite(array)
            if bad.any():
                row, channel = np.argwhere(bad)[0]
                raise ValueError(
                    f"{self.name}: readings['{name}'] row {row}, channel {channel} is not finite; "
                    "for a missing value store 0 and set seen to False"
                )

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        sensors = ", ".join(f"{name} ({np.shape(r.values)[1]})" for name, r in self.readings.items())
        truth = f"; truth of {', '.join(self.truth)}" if self.truth else ""
        return (
            f"<Recording '{self.name}': {len(self)} rows, {self.times[0]:g} to {self.times[-1]:g} s; {sensors}{truth}>"
        )


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


class Row(NamedTuple):
    """One time step of one trajectory.

    `dt`: s since the previous step. `key` (2,): random key of the trajectory. `number`: index of the time step.
    """

    dt: Scalar
    valid: Scalar
    readings: dict[str, Reading]
    inputs: Inputs
    key: Any
    number: Scalar


def stack(
    recordings: Sequence[Recording], rows: int | None = None, dtype: DTypeLike | None = None, seed: int = 0
) -> Batch:
    """The recordings as one batch, padded to `rows` (default: the longest), floats in `dtype` (default: jax's).

    `seed`: with the ids of the recordings it gives the random keys, for filters that draw random numbers.

    All recordings name the same sensors, inputs and truths; `dt` is computed here, in float64.
    """
    dtype = dtype or jnp.zeros(0).dtype
    longest = max(len(r) for r in recordings)
    rows = rows or longest
    if rows < longest:
        raise ValueError(f"rows = {rows} is less than the longest recording's {longest}")
    first = recordings[0]
    for other in recordings:
        for what in ("readings", "inputs", "truth"):
            mine, theirs = getattr(first, what), getattr(other, what)
            if set(mine) != set(theirs):
                raise ValueError(
                    f"stack: '{other.name}' has {what} {sorted(theirs)}, '{first.name}' {sorted(mine)}; expected the "
                    "same names in all; leave the others out, or stack these recordings apart"
                )

    def pile(arrays: Sequence[np.ndarray], kind: DTypeLike) -> Shaped[np.ndarray, "rows *shape B"]:
        shape = np.shape(arrays[0])[1:]
        for other, array in zip(recordings, arrays, strict=True):
            if np.shape(array)[1:] != shape:
                raise ValueError(f"'{other.name}' has rows of shape {np.shape(array)[1:]}, '{first.name}' of {shape}")
        out = np.zeros((rows, *shape, len(arrays)), kind)
        for trajectory, array in enumerate(arrays):
            out[: len(array), ..., trajectory] = array
        return out

    readings = {}
    for name in first.readings:
        every = [r.readings[name] for r in recordings]
        readings[name] = Reading(
            pile([e.values for e in every], dtype),
            pile([e.seen for e in every], bool),
            pile([np.zeros((len(e.values), 0)) if e.reported is None else e.reported for e in every], dtype),
        )
    return Batch(
        dt=pile([np.diff(r.times, prepend=r.times[:1]) for r in recordings], dtype),
        valid=pile([np.ones(len(r), bool) for r in recordings], bool),
        readings=readings,
        inputs={k: pile([r.inputs[k] for r in recordings], dtype) for k in first.inputs},
        truth={
            k: (pile([r.truth[k][0] for r in recordings], dtype), pile([r.truth[k][1] for r in recordings], bool))
            for k in first.truth
        },
        key=trajectory_key_data(seed, [k if r.id is None else r.id for k, r in enumerate(recordings)]),
    )
