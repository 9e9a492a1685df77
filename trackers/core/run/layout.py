"""The layout of recordings: names and shapes of their arrays, as trackers compare them with the arrays that they read.

Messages are one sentence: where, found, expected, usual fix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.recording import Batch, Recording
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.sensor import Channel


class Layout(NamedTuple):
    """Names and shapes of the arrays of recordings, which are the same in each of them.

    `where`: for messages. `readings`: the numbers of channels and of reported noise columns. `inputs`: the shape of one
    row. `truth`: the number of columns. `arrays`: the inputs of each recording, or of the batch.
    """

    where: str
    readings: Mapping[str, tuple[int, int]]
    inputs: Mapping[str, tuple[int, ...]]
    truth: Mapping[str, int]
    arrays: Sequence[Mapping[str, Any]]

    @classmethod
    def of_recording(cls, recording: Recording) -> Layout:
        """The layout of a recording in arrays."""
        return cls(
            f"recording '{recording.name}'",
            {
                name: (np.shape(r.values)[1], 0 if r.reported is None else np.shape(r.reported)[1])
                for name, r in recording.readings.items()
            },
            {name: np.shape(x)[1:] for name, x in recording.inputs.items()},
            {name: np.shape(values)[1] for name, (values, _) in recording.truth.items()},
            [recording.inputs],
        )

    @classmethod
    def of_batch(cls, batch: Batch) -> Layout:
        """The layout of a batch; raises UnusableInput for arrays that are not batch-last."""
        rows, size = np.shape(batch.dt)
        arrays = {f"readings['{name}'].values": r.values for name, r in batch.readings.items()}
        arrays |= {f"inputs['{name}']": x for name, x in batch.inputs.items()}
        arrays |= {f"truth['{name}']": values for name, (values, _) in batch.truth.items()}
        for name, array in arrays.items():
            shape = np.shape(array)
            if shape[:1] != (rows,) or shape[-1:] != (size,):
                raise UnusableInput(
                    f"the batch: {name} has shape {shape}; expected ({rows}, …, {size}), rows first and trajectories "
                    "last as `dt`; usual fix: make it by `stack` of recordings"
                )
        return cls(
            "the batch",
            {
                name: (np.shape(r.values)[1], np.shape(r.reported)[1] if np.ndim(r.reported) == 3 else 0)
                for name, r in batch.readings.items()
            },
            {name: np.shape(x)[1:-1] for name, x in batch.inputs.items()},
            {name: np.shape(values)[1] for name, (values, _) in batch.truth.items()},
            [batch.inputs],
        )

    @classmethod
    def of_recordings(cls, recordings: Sequence[Recording]) -> Layout:
        """The layout of several recordings; raises UnusableInput where they differ in more than the names of inputs."""
        first = cls.of_recording(recordings[0])
        for number, recording in enumerate(recordings[1:], 1):
            other = cls.of_recording(recording)
            for what in ("readings", "inputs", "truth"):
                one, two = getattr(first, what), getattr(other, what)
                names = one.keys() & two.keys() if what == "inputs" else [*one, *two]
                name = next((k for k in names if one.get(k) != two.get(k)), None)
                if name is not None:
                    raise UnusableInput(
                        f"the recordings differ: {what}['{name}'] is {_described(what, one.get(name))} in recording 0 "
                        f"('{recordings[0].name}') and {_described(what, two.get(name))} in recording {number} "
                        f"('{recording.name}'); expected the same names and shapes in all of them; usual fix: make all "
                        "by the same helper with the same arguments, or run them one by one"
                    )
        return first._replace(arrays=[r.inputs for r in recordings])

    def check_readings(self, reader: str, name: str, channels: Sequence[Channel] | int) -> None:
        """Raises UnusableInput without readings `name`, or without exactly these channels, or at least so many."""
        if name not in self.readings:
            raise UnusableInput(
                f"{self.where}: found readings of {listed(self.readings) or 'no sensor'}; expected '{name}', which "
                f"{reader} reads; usual fix: give the readings the name of the sensor, or run a tracker of these "
                "readings"
            )
        found = self.readings[name][0]
        if isinstance(channels, int):
            expected, fits = f"at least the {channels} that {reader} reads", found >= channels
        else:
            expected, fits = f"the {len(channels)} of {reader}, {_span(channels)}", found == len(channels)
        if not fits:
            raise UnusableInput(
                f"{self.where}: readings['{name}'] has {_count(found, 'channel')}; expected {expected}; usual fix: one "
                "column per channel, with seen = False where a value is missing"
            )

    def check_reported(self, reader: str, name: str, columns: Sequence[Channel]) -> None:
        """Raises UnusableInput for reported noise in other columns than a sensor reads; none is always accepted."""
        found = self.readings[name][1]
        if found and columns and found != len(columns):
            raise UnusableInput(
                f"{self.where}: readings['{name}'].reported has {_count(found, 'column')}; expected the {len(columns)} "
                f"of {reader}, {_span(columns)}, or none; usual fix: the square of each standard deviation, or leave "
                "`reported` out"
            )

    def check_inputs(self, reader: str, inputs: Sequence[Input], channels: int, needs: Sequence[Need]) -> None:
        """Raises UnusableInput for an input of one of the `needs` that is missing, or of another shape or range."""
        for declared in inputs:
            if declared.need not in needs:
                continue
            shape = declared.row_shape(channels)
            expected = f"expected {_rows(shape)}{f' {declared.unit}' if declared.unit else ''}, {declared.about}"
            reads = f"which {reader} reads"
            if declared.need is not Need.ALWAYS:
                reads += f" {declared.need.value}"
            source = f"make it by {declared.source}" if declared.source else "add it to the recording's `inputs`"
            if declared.name not in self.inputs:
                if declared.need is not Need.IF_GIVEN:
                    raise UnusableInput(
                        f"{self.where}: no input '{declared.name}', found {listed(self.inputs, 8) or 'none'}; "
                        f"{expected}, {reads}; usual fix: {source}"
                    )
                continue
            found = self.inputs[declared.name]
            if found != shape:
                raise UnusableInput(
                    f"{self.where}: inputs['{declared.name}'] has {_rows(found)}; {expected}, {reads}; usual fix: "
                    f"{source}"
                )
            if declared.below is not None:
                self._check_range(reader, declared, declared.below)

    def _check_range(self, reader: str, declared: Input, below: int) -> None:
        for arrays in self.arrays:
            low, high = _extremes(arrays[declared.name])
            if low < 0 or high >= below:
                found, fix = (low, "count from 0") if low < 0 else (high, f"build the tracker for {high + 1:g}")
                raise UnusableInput(
                    f"{self.where}: inputs['{declared.name}'], {declared.about}, is {found:g} in a row; expected 0 to "
                    f"{below - 1}, since {reader} is built for {below}; usual fix: {fix}"
                )


def _extremes(array: Any) -> tuple[float, float]:
    """The smallest and the largest number of an array; (0, 0) of a traced one and of none."""
    if isinstance(array, jax.core.Tracer) or not np.size(array):
        return 0.0, 0.0
    kind = jnp if isinstance(array, jax.Array) else np
    return float(kind.min(array)), float(kind.max(array))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _rows(shape: tuple[int, ...]) -> str:
    return f"rows of shape {shape}" if shape else "one number per row,"


def _span(channels: Sequence[Channel]) -> str:
    """The names of channels, the first and the last of many, and their unit."""
    names = [c.name for c in channels]
    shown = ", ".join(names) if len(names) <= 4 else f"{names[0]} … {names[-1]}"
    return shown + (f", {channels[0].unit}" if channels and channels[0].unit else "")


def _described(what: str, shape: Any) -> str:
    if shape is None:
        return "missing"
    if what == "readings":
        return f"of {_count(shape[0], 'channel')} with {_count(shape[1], 'reported column')}"
    return f"of {_count(shape, 'column')}" if what == "truth" else f"of shape {shape} per row"
