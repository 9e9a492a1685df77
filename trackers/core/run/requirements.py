"""The check of recordings against a tracker before a run: their type, names, channels, inputs and the motion's view.

It compares the layout of recordings, the names and shapes of their arrays, with what the parts of a tracker read, and
the range of inputs that are indices; no row is filtered. Messages are one sentence: where, found, expected, usual fix.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.recording import Batch, Recording
from trackwright.trackers.core.errors import UnusableInput, counted, listed
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Reading, Row
from trackwright.trackers.core.run.scan import RecursiveTracker

KINDS = {
    "RecordingFolder": "a tracker by name, `tw.tracker_for(folder)`",
    "SimulatedWorld": "its `recordings()`, or its `folder()` for a tracker by name",
    "Trajectory": "its `recording`",
    "Estimates": "the recording itself; estimates become measurements by `fix_recording`",
    "Tracks": "the recording itself; estimates become measurements by `fix_recording`",
    "DataFrame": "a recording of its columns, by `fix_recording` or `range_recording`",
    "ndarray": "a recording of arrays, by `fix_recording` or `range_recording`",
    "dict": "`Recording(times, readings, inputs)`, or the values as a list",
    "str": "`folder = tw.read(path)` and a tracker by name, `tw.tracker_for(folder)`",
    "PosixPath": "`folder = tw.read(path)` and a tracker by name, `tw.tracker_for(folder)`",
    "Batch": "each batch by itself, or `stack` of all recordings",
}
"""The usual fix, by the type of an argument that is no recording."""


class Layout(NamedTuple):
    """Names and shapes of the arrays of recordings, which are the same in each of them.

    `where`: their name in messages. `readings`: numbers of channels and of reported noise columns. `inputs`: shape of
    one row. `truth`: number of columns. `arrays`: the inputs of each recording, or of the batch.
    """

    where: str
    readings: Mapping[str, tuple[int, int]]
    inputs: Mapping[str, tuple[int, ...]]
    truth: Mapping[str, int]
    arrays: Sequence[Mapping[str, Any]]

    @classmethod
    def of(cls, where: str, rows: Recording | Batch, after: int = 0) -> Layout:
        """The layout of rows, whose arrays have so many axes `after` those of one trajectory."""

        def shape(array: Any) -> tuple[int, ...]:
            return np.shape(array)[1 : np.ndim(array) - after]

        return cls(
            where,
            {name: (shape(r.values)[0], (*shape(r.reported), 0)[0]) for name, r in rows.readings.items()},
            {name: shape(x) for name, x in rows.inputs.items()},
            {name: shape(values)[0] for name, (values, _) in rows.truth.items()},
            [rows.inputs],
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
        return cls.of("the batch", batch, 1)

    @classmethod
    def of_recordings(cls, recordings: Sequence[Recording]) -> Layout:
        """The layout of recordings; raises UnusableInput where they differ in more than the names of inputs."""
        first = cls.of(f"recording '{recordings[0].name}'", recordings[0])
        for number, recording in enumerate(recordings[1:], 1):
            other = cls.of("", recording)
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

    def check_readings(
        self, reader: str, name: str, channels: Sequence[Channel] | int, reported: Sequence[Channel] = ()
    ) -> None:
        """Raises UnusableInput without readings `name` with exactly these channels, or with at least this number.

        Also for other noise than `reported`; none is always accepted.
        """
        if name not in self.readings:
            raise UnusableInput(
                f"{self.where}: found readings of {listed(self.readings) or 'no sensor'}; expected '{name}', which "
                f"{reader} reads; usual fix: give the readings the name of the sensor, or run a tracker of these "
                "readings"
            )
        number = self.readings[name][0]
        if isinstance(channels, int):
            expected, fits = f"at least the {channels} that {reader} reads", number >= channels
        else:
            expected, fits = f"the {len(channels)} of {reader}, {_span(channels)}", number == len(channels)
        if not fits:
            raise UnusableInput(
                f"{self.where}: readings['{name}'] has {counted(number, 'channel')}; expected {expected}; usual fix: "
                "one column per channel, with seen = False where a value is missing"
            )

        noise = self.readings[name][1]
        if noise and reported and noise != len(reported):
            raise UnusableInput(
                f"{self.where}: readings['{name}'].reported has {counted(noise, 'column')}; expected the "
                f"{len(reported)} of {reader}, {_span(reported)}, or none; usual fix: the square of each standard "
                "deviation, or leave `reported` out"
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
            given = self.inputs[declared.name]
            if given != shape:
                raise UnusableInput(
                    f"{self.where}: inputs['{declared.name}'] has {_rows(given)}; {expected}, {reads}; usual fix: "
                    f"{source}"
                )
            if declared.below is not None:
                self._check_range(reader, declared, declared.below)

    def _check_range(self, reader: str, declared: Input, below: int) -> None:
        for arrays in self.arrays:
            low, high = _extremes(arrays[declared.name])
            if low < 0 or high >= below:
                outlier, fix = (low, "count from 0") if low < 0 else (high, f"build the tracker for {high + 1:g}")
                raise UnusableInput(
                    f"{self.where}: inputs['{declared.name}'], {declared.about}, is {outlier:g} in a row; expected 0 "
                    f"to {below - 1}, since {reader} is built for {below}; usual fix: {fix}"
                )


def _extremes(array: Any) -> tuple[float, float]:
    """The smallest and the largest number of an array; (0, 0) of a traced one and of none."""
    if isinstance(array, jax.core.Tracer) or not np.size(array):
        return 0.0, 0.0
    kind = jnp if isinstance(array, jax.Array) else np
    return float(kind.min(array)), float(kind.max(array))


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
        return f"of {counted(shape[0], 'channel')} with {counted(shape[1], 'reported column')}"
    return f"of {counted(shape, 'column')}" if what == "truth" else f"of shape {shape} per row"


def check_input(tracker: Any, recordings: Any, caller: str) -> Recording | list[Recording] | Batch:
    """The recording, the recordings as a list, or the batch, checked to have what the tracker reads.

    Of several recordings only the inputs that all of them have are kept, since a batch has one array of each. Raises
    UnusableInput, in the name of the `caller`, for anything else and for recordings that lack something. The time
    of the check does not grow with the rows, except for inputs that are indices of anchors.
    """
    if isinstance(recordings, Recording):
        tracker.check_layout(Layout.of_recordings([recordings]))
        return recordings
    if isinstance(recordings, Batch):
        tracker.check_layout(Layout.of_batch(recordings))
        return recordings
    # A list, a tuple or a generator may hold recordings; a table, array, text or mapping does not.
    sequence = type(recordings).__name__ not in KINDS and hasattr(recordings, "__iter__")
    several = list(recordings) if sequence else [recordings]
    wrong = [x for x in several if not isinstance(x, Recording)]
    if wrong or not several:
        kind = type(wrong[0]).__name__ if wrong else "nothing"
        among = " in a sequence" if wrong and wrong[0] is not recordings else ""
        fix = KINDS.get(kind, "`fix_recording`, `range_recording`, `bearing_recording` or `phase_recording`")
        raise UnusableInput(
            f"{caller}: found {kind}{among}; expected a Recording, several, or a Batch; usual fix: {fix}"
        )
    shared = set.intersection(*(set(r.inputs) for r in several))
    layout = Layout.of_recordings(several)
    if any(len(r.inputs) > len(shared) for r in several):
        # An input that a tracker does not read, as the height of a state in space, need not be in every recording.
        several = [replace(r, inputs={name: x for name, x in r.inputs.items() if name in shared}) for r in several]
        layout = Layout.of_recordings(several)._replace(where="the recordings together")
    tracker.check_layout(layout)
    return several


class MissingInputError(KeyError):
    """A part reads an input, or readings, neither declared nor given: its reader, its name, and whether of readings."""

    def __str__(self) -> str:
        return repr(self.args[1])


class GivenInputs(dict[str, Any]):
    """The inputs of a row, or its `readings`; a missing one raises MissingInputError with the name of its reader."""

    def __init__(self, values: Mapping[str, Any], reader: str, readings: bool = False) -> None:
        super().__init__(values)
        self.reader, self.readings = reader, readings

    def __missing__(self, name: str) -> Any:
        raise MissingInputError(self.reader, name, self.readings)


def check_parts(layout: Layout, tracker: RecursiveTracker) -> None:
    """Raises UnusableInput unless recordings of this layout have what the parts of a recursive tracker read."""
    for name, sensor in tracker.sensors.items():
        layout.check_readings(_sensor(name, sensor), name, sensor.channels, sensor.reported)
    for name, least in tracker.start.readings.items():
        layout.check_readings(f"the start ({type(tracker.start).__name__})", name, least)
    readers = list(_readers(tracker))
    for reader, inputs, channels in readers:
        layout.check_inputs(reader, inputs, channels, (Need.ALWAYS, Need.IF_GIVEN))
    view = _initial_view(layout, tracker)
    fields = {_sensor(name, sensor): sensor.view_fields for name, sensor in tracker.sensors.items()}
    fields[f"the filter ({type(tracker.filter).__name__})"] = tracker.filter.view_fields
    for reader, names in fields.items():
        for name in names:
            if not hasattr(view, name):
                shown = listed(getattr(view, "_fields", ()), 8) or type(view).__name__
                raise UnusableInput(
                    f"the view of {type(tracker.motion).__name__} has {shown}; expected '{name}', which {reader} "
                    f"reads; usual fix: a motion whose state has '{name}', or whose `view` computes it"
                )
    if len(getattr(view, "position", ())) == 2:
        for reader, inputs, channels in readers:
            layout.check_inputs(reader, inputs, channels, (Need.PLANAR,))


def _readers(tracker: RecursiveTracker) -> Iterator[tuple[str, Sequence[Input], int]]:
    """Every part by a name for messages, its declared inputs, and the number of channels of its readings."""
    yield f"the motion ({type(tracker.motion).__name__})", tracker.motion.inputs, 0
    for name, sensor in tracker.sensors.items():
        yield _sensor(name, sensor), sensor.inputs, len(sensor.channels)
    yield f"the start ({type(tracker.start).__name__})", tracker.start.inputs, 0
    yield f"the filter ({type(tracker.filter).__name__})", tracker.filter.inputs, 0
    yield f"the track loss ({type(tracker.track_loss).__name__})", tracker.track_loss.inputs, 0


def _initial_view(layout: Layout, tracker: RecursiveTracker) -> Any:
    """The shapes of `motion.view` of a start's state; declared inputs that are missing are filled in.

    Raises UnusableInput for an undeclared input that is read and missing from the recordings.
    """
    inputs = dict(layout.inputs)
    for _, declared, channels in _readers(tracker):
        for entry in declared:
            if entry.need is not Need.IF_GIVEN and entry.name not in inputs:
                inputs[entry.name] = entry.row_shape(channels)
    leaves, tree = jax.tree_util.tree_flatten((tracker.motion, tracker.sensors, tracker.start))
    numeric = [isinstance(x, (float, np.ndarray, np.floating, jax.Array)) for x in leaves]
    fixed = tuple(None if n else x for n, x in zip(numeric, leaves, strict=True))
    shapes = tuple((np.shape(x), np.result_type(x)) if n else None for n, x in zip(numeric, leaves, strict=True))
    kind = jax.dtypes.canonicalize_dtype(float)
    try:
        return _view_of(tree, fixed, shapes, tuple(layout.readings.items()), tuple(inputs.items()), kind)
    except MissingInputError as missing:
        reader, name, of_readings = missing.args
        if of_readings:
            layout.check_readings(reader, name, 0)
        raise UnusableInput(
            f"{layout.where}: no input '{name}', found {listed(layout.inputs, 8) or 'none'}; expected it, "
            f"since {reader} reads it; usual fix: add it to the recording's `inputs`, one row per time"
        ) from None


@lru_cache(maxsize=256)
def _view_of(
    tree: Any, fixed: tuple[Any, ...], shapes: tuple[Any, ...], readings: tuple[tuple[str, tuple[int, int]], ...],
    inputs: tuple[tuple[str, tuple[int, ...]], ...], kind: Any,
) -> Any:  # fmt: skip
    """The shapes of the view of a start's state, cached, so that a second check traces nothing.

    `tree`: structure of motion, sensors and start, whose leaves are `fixed` or arrays with these `shapes`; `kind`: the
    type of floats.
    """

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind)

    def number(shape: tuple[int, ...], dtype: np.dtype[Any]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind if np.issubdtype(dtype, np.floating) else dtype)

    given: dict[str, Any] = {name: array(*shape) for name, shape in inputs}
    row = Row(
        array(),
        jax.ShapeDtypeStruct((), bool),
        {name: Reading(array(m), jax.ShapeDtypeStruct((m,), bool), array(k)) for name, (m, k) in readings},
        given,
        jax.ShapeDtypeStruct((2,), np.uint32),
        jax.ShapeDtypeStruct((), np.uint32),
    )

    def view(numbers: list[Any], row: Row) -> Any:
        leaves = [f if n is None else n for f, n in zip(fixed, numbers, strict=True)]
        motion, sensors, start = jax.tree_util.tree_unflatten(tree, leaves)
        reader = f"the start ({type(start).__name__})"
        given = row._replace(
            readings=GivenInputs(row.readings, reader, readings=True), inputs=GivenInputs(row.inputs, reader)
        )
        start.can_start(given)
        state = start.belief(start.candidate(sensors, given), given).mean
        inputs = GivenInputs(row.inputs, f"the motion ({type(motion).__name__})")
        motion.step(state, inputs, row.dt, Vector(*[row.dt] * motion.noise_dimension))
        of_state = motion.view(state)
        for name, sensor in sensors.items():
            if all(hasattr(of_state, field) for field in sensor.view_fields):
                sensor.measure(of_state, GivenInputs(row.inputs, _sensor(name, sensor)))
        return of_state

    return jax.eval_shape(view, [None if s is None else number(*s) for s in shapes], row)


def _sensor(name: str, sensor: AbstractSensor) -> str:
    return f"sensor '{name}' ({type(sensor).__name__})"
