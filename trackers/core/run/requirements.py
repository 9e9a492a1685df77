"""The check of recordings against a tracker before it runs: their kind, names, channels, inputs and the motion's view.

Only names and shapes are compared, and the range of inputs that number something; no row is filtered.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from trackwright.trackers.core.data.recording import Batch, Recording
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.filters.filter import AbstractFilter
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor, Reading, Row
from trackwright.trackers.core.model.start import AbstractStart
from trackwright.trackers.core.run.layout import Layout
from trackwright.trackers.core.run.track_loss import AbstractTrackLoss

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
"""The usual fix by the type of what was given in place of a recording."""


@runtime_checkable
class ChecksLayout(Protocol):
    """A tracker, as the check sees it."""

    def check_layout(self, layout: Layout) -> None: ...


def check_input(tracker: ChecksLayout, recordings: Any, caller: str) -> Recording | list[Recording] | Batch:
    """The recording, the recordings as a list, or the batch, once they have what the tracker reads.

    Of several recordings only the inputs that all of them have are kept, since a batch has one array of each. Raises
    UnusableInput, in the name of the `caller`, for anything else and for recordings that lack something. The
    check compares names and shapes: its time does not grow with rows, but for inputs that number anchors.
    """
    if isinstance(recordings, Recording):
        tracker.check_layout(Layout.of_recording(recordings))
        return recordings
    if isinstance(recordings, Batch):
        tracker.check_layout(Layout.of_batch(recordings))
        return recordings
    several = list(recordings) if _is_sequence(recordings) else [recordings]
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


def _is_sequence(recordings: Any) -> bool:
    """Whether it may hold recordings: a list, a tuple, a generator; tables, arrays, texts and mappings hold none."""
    return type(recordings).__name__ not in KINDS and hasattr(recordings, "__iter__")


class MissingInputError(KeyError):
    """A part reads an input that is neither declared nor given: `reader` and `name`."""

    def __init__(self, reader: str, name: str) -> None:
        super().__init__(name)
        self.reader, self.name = reader, name


class GivenInputs(dict[str, Any]):
    """The inputs of a row, which name the reader of one that is missing."""

    def __init__(self, values: Mapping[str, Any], reader: str) -> None:
        super().__init__(values)
        self.reader = reader

    def __missing__(self, name: str) -> Any:
        raise MissingInputError(self.reader, name)


class Parts(NamedTuple):
    """The parts of a recursive tracker that read rows."""

    motion: AbstractMotion
    sensors: Mapping[str, AbstractSensor]
    start: AbstractStart
    filter: AbstractFilter[Any]
    track_loss: AbstractTrackLoss

    def readers(self) -> Iterator[tuple[str, Sequence[Input], int]]:
        """Every part by a name for messages, its declared inputs, and the number of channels of its readings."""
        yield f"the motion ({type(self.motion).__name__})", self.motion.inputs, 0
        for name, sensor in self.sensors.items():
            yield _sensor(name, sensor), sensor.inputs, len(sensor.channels)
        yield f"the start ({type(self.start).__name__})", self.start.inputs, 0
        yield f"the filter ({type(self.filter).__name__})", self.filter.inputs, 0
        yield f"the track loss ({type(self.track_loss).__name__})", self.track_loss.inputs, 0


def check_parts(layout: Layout, parts: Parts) -> None:
    """Raises UnusableInput unless recordings of this layout have what the parts of a recursive tracker read."""
    for name, sensor in parts.sensors.items():
        layout.check_readings(_sensor(name, sensor), name, sensor.channels)
        layout.check_reported(_sensor(name, sensor), name, sensor.reported)
    for name, least in parts.start.readings.items():
        layout.check_readings(f"the start ({type(parts.start).__name__})", name, least)
    readers = list(parts.readers())
    for reader, inputs, channels in readers:
        layout.check_inputs(reader, inputs, channels, (Need.ALWAYS, Need.IF_GIVEN))
    view = initial_view(layout, parts)
    fields = {_sensor(name, sensor): sensor.view_fields for name, sensor in parts.sensors.items()}
    fields[f"the filter ({type(parts.filter).__name__})"] = parts.filter.view_fields
    for reader, names in fields.items():
        for name in names:
            if not hasattr(view, name):
                shown = listed(getattr(view, "_fields", ()), 8) or type(view).__name__
                raise UnusableInput(
                    f"the view of {type(parts.motion).__name__} has {shown}; expected '{name}', which {reader} reads; "
                    f"usual fix: a motion whose state has '{name}', or whose `view` computes it"
                )
    if len(getattr(view, "position", ())) == 2:
        for reader, inputs, channels in readers:
            layout.check_inputs(reader, inputs, channels, (Need.PLANAR,))


def initial_view(layout: Layout, parts: Parts) -> Any:
    """`motion.view` of a state that the start makes, in shapes; inputs that are declared and missing are filled in.

    Raises UnusableInput for an input that is read without being declared, where the recordings lack it.
    """
    inputs = dict(layout.inputs)
    for _, declared, channels in parts.readers():
        for one in declared:
            if one.need is not Need.IF_GIVEN and one.name not in inputs:
                inputs[one.name] = one.row_shape(channels)
    leaves, tree = jax.tree_util.tree_flatten((parts.motion, parts.sensors, parts.start))
    numeric = [isinstance(x, (float, np.ndarray, np.floating, jax.Array)) for x in leaves]
    fixed = tuple(None if n else x for n, x in zip(numeric, leaves, strict=True))
    shapes = tuple((np.shape(x), np.result_type(x)) if n else None for n, x in zip(numeric, leaves, strict=True))
    kind = jax.dtypes.canonicalize_dtype(float)
    try:
        return _view_of(tree, fixed, shapes, tuple(layout.readings.items()), tuple(inputs.items()), kind)
    except MissingInputError as missing:
        raise UnusableInput(
            f"{layout.where}: no input '{missing.name}', found {listed(layout.inputs, 8) or 'none'}; expected it, "
            f"since {missing.reader} reads it; usual fix: add it to the recording's `inputs`, one row per time"
        ) from None


@lru_cache(maxsize=256)
def _view_of(
    tree: Any,
    fixed: tuple[Any, ...],
    shapes: tuple[Any, ...],
    readings: tuple[tuple[str, tuple[int, int]], ...],
    inputs: tuple[tuple[str, tuple[int, ...]], ...],
    kind: Any,
) -> Any:
    """The shapes of the view after the start, kept, so that a second check traces nothing.

    Motion, sensors and start are a `tree` of `fixed` leaves and of numbers with these `shapes`; `kind`: of floats.
    """

    def array(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind)

    def number(shape: tuple[int, ...], own: np.dtype[Any]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, kind if np.issubdtype(own, np.floating) else own)

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
        given = row._replace(inputs=GivenInputs(row.inputs, f"the start ({type(start).__name__})"))
        state = start.belief(start.candidate(sensors, given), given).mean
        inputs = GivenInputs(row.inputs, f"the motion ({type(motion).__name__})")
        motion.step(state, inputs, row.dt, Vector(*[row.dt] * motion.noise_dimension))
        found = motion.view(state)
        for name, sensor in sensors.items():
            if all(hasattr(found, field) for field in sensor.view_fields):
                sensor.measure(found, GivenInputs(row.inputs, _sensor(name, sensor)))
        return found

    return jax.eval_shape(view, [None if s is None else number(*s) for s in shapes], row)


def _sensor(name: str, sensor: AbstractSensor) -> str:
    return f"sensor '{name}' ({type(sensor).__name__})"
