"""Every part declares the inputs and the view fields that it reads, and docs/inputs.md lists them all."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from tests.catalogue import CASES, SENSORS
from trackwright.trackers.aoa.cascade import Cascade
from trackwright.trackers.core.data.recording import Batch, stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.inputs import Input, Need
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.run.requirements import Layout
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker

PAGE = Path(__file__).parents[4] / "docs/inputs.md"
SLOW = (pytest.mark.slow,)
FORWARD = {name: case for name, case in CASES.items() if "smoothed" not in name}


class Spy(dict):
    """Inputs that remember which of them were read."""

    def __init__(self, values):
        super().__init__(values)
        self.read = set()

    def __getitem__(self, name):
        self.read.add(name)
        return super().__getitem__(name)


def _recursive(tracker: AbstractTracker) -> list[Any]:
    """The recursive trackers inside a tracker, which may be one itself."""
    if isinstance(tracker, Cascade):
        return [*tracker.beams.values(), tracker.fusion]
    inner = getattr(tracker, "fusion", getattr(tracker, "tracker", tracker))
    return [inner] if hasattr(inner, "motion") else []


def _readers(tracker: AbstractTracker) -> list[Any]:
    """All parts of a tracker that may read inputs."""
    inner = [p for t in _recursive(tracker) for p in (t.motion, *t.sensors.values(), t.start, t.filter, t.track_loss)]
    return inner or [tracker]


def _inputs(part: Any) -> tuple[Input, ...]:
    """The inputs of a part; a tracker of single rows that reads none declares none."""
    return getattr(part, "inputs", ())


def _parts_read_what_they_declare(tracker: Any, batch: Batch) -> None:
    dt, valid, readings = jax.tree_util.tree_map(
        lambda x: np.asarray(x)[0, ..., 0], (batch.dt, batch.valid, batch.readings)
    )
    values = {key: np.asarray(x)[0, ..., 0] for key, x in batch.inputs.items()}
    spies = {reader: Spy(values) for reader in ("start", "motion", "filter", *tracker.sensors)}

    def view_of_all():
        row = Row(dt, valid, readings, spies["start"], np.zeros(2, np.uint32), np.uint32(0))
        tracker.start.can_start(row)
        belief = tracker.start.belief(tracker.start.candidate(tracker.sensors, row), row)
        view = tracker.motion.view(belief.mean)
        for sensor in tracker.sensors:
            tracker.sensors[sensor].measure(view, spies[sensor])
        w = Vector(*[row.dt] * tracker.motion.noise_dimension)
        tracker.motion.step(belief.mean, spies["motion"], row.dt, w)
        tracker.filter.predict(tracker.filter.init(belief, row.key), tracker.motion, spies["filter"], row.dt)
        return view

    planar = len(getattr(jax.eval_shape(view_of_all), "position", ())) == 2
    declared = {"start": tracker.start.inputs, "motion": tracker.motion.inputs}
    declared |= {sensor: part.inputs for sensor, part in tracker.sensors.items()}
    declared["filter"] = (*tracker.filter.inputs, *tracker.motion.inputs)
    for reader, inputs in declared.items():
        # The belief of a start of the tests is an input; a start on a path evaluates the sensors along it.
        read = {key for key in spies[reader].read if not key.startswith("start_")}
        others = [one for part in tracker.sensors.values() for one in part.inputs] if reader == "start" else []
        assert read <= {one.name for one in (*inputs, *others)}, reader
        always = (Need.ALWAYS, Need.PLANAR) if planar else (Need.ALWAYS,)
        assert {one.name for one in inputs if one.need in always} <= read, reader


def _runs_with_what_is_declared(tracker: AbstractTracker, batch: Batch) -> None:
    declared = {one.name for part in _readers(tracker) for one in _inputs(part)}
    batch = batch._replace(inputs={key: x for key, x in batch.inputs.items() if key in declared}).rows(slice(0, 3))
    tracker.check_layout(Layout.of_batch(batch))
    jax.eval_shape(lambda: tracker.scan(batch))


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=name, marks=SLOW * bool(re.search("cascade| in space", name)))
        for name, case in FORWARD.items()
    ],
)
def test_a_tracker_reads_the_inputs_that_its_parts_declare(case):
    tracker, batch = case.tracker(), stack([case.recordings()[0]])
    (_parts_read_what_they_declare if isinstance(tracker, Tracker) else _runs_with_what_is_declared)(tracker, batch)


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_reads_the_fields_of_the_view_that_it_declares(name):
    case = SENSORS[name]
    fields = {field: getattr(case.view, field) for field in case.sensor.view_fields}

    def measured(view):
        return jax.eval_shape(lambda: list(case.sensor.measure(view, case.inputs)))

    assert len(measured(SimpleNamespace(**fields))) == len(case.sensor.channels)
    for field in fields:
        with pytest.raises(AttributeError, match=field):
            measured(SimpleNamespace(**{key: x for key, x in fields.items() if key != field}))


def _table() -> list[str]:
    """The rows of the page, from the declarations of all parts and trackers of the catalogue."""
    declared: dict[str, Input] = {}
    readers: dict[str, set[str]] = {}
    for case in FORWARD.values():
        for part in _readers(case.tracker()):
            for one in _inputs(part):
                assert declared.setdefault(one.name, one)._replace(below=None) == one._replace(below=None)
                readers.setdefault(one.name, set()).add(type(part).__name__)
    rows = []
    for name, one in sorted(declared.items()):
        shape = str(one.shape).replace(" ", "")
        if one.per_channel:
            shape = "(slots,)" if one.shape == (1,) else f"({one.shape[0]}·slots,)"
        need = "" if one.need is Need.ALWAYS else f"; {one.need.value}"
        of = ", ".join(f"`{reader}`" for reader in sorted(readers[name]))
        rows.append(f"| `{name}` | `{shape}` | {one.unit or '1'} | {one.about}{need} | {of} | {one.source} |")
    return rows


def test_the_page_of_inputs_equals_the_declarations():
    listed = [line for line in PAGE.read_text("utf-8").splitlines() if line.startswith("| `")]
    assert listed == _table()
