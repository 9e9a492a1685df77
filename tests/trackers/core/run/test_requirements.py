"""Mistakes of a Python user are refused before anything is traced, each in one sentence with the usual fix."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.inputs import Input
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, independent

ROWS = 30
TIMES = np.arange(ROWS) * 0.1
PATH = np.stack([4 + 2 * np.cos(TIMES), 3 + 1.5 * np.sin(TIMES), 1.0 + 0.0 * TIMES], axis=1)
ANCHORS = np.array([[0.0, 0.0, 2.5], [8.0, 0.0, 1.0], [8.0, 6.0, 2.5], [0.0, 6.0, 1.0]])
DISTANCES = np.linalg.norm(PATH[:, None] - ANCHORS, axis=-1)
STATIONS = tw.sim.work_station().stations
PHASES = np.zeros((ROWS, 8))


class Place(NamedTuple):
    """A state without a velocity."""

    position: Any


class Car(tw.AbstractMotion):
    """A motion whose state has a position alone."""

    noise_dimension = 2

    def step(self, state, inputs, dt, w):
        return Place(state.position + w * (0.1 * dt))


class Parked(tw.AbstractStart):
    """A start at the first row."""

    def can_start(self, row):
        return row.valid

    def candidate(self, sensors, row):
        return 0.0 * row.dt

    def belief(self, candidate, row):
        return tw.Gaussian(Place(Vector(candidate, candidate)), tw.diagonal([1.0, 1.0], candidate))


class ParkedAtFix(Parked):
    """A start by readings whose name is misspelt."""

    def can_start(self, row):
        return row.readings["fix"].seen[0]


class Odometer(AbstractSensor):
    """Reads an input that it declares."""

    @property
    def inputs(self):
        return (Input("wheel", (), "m", "the radius of the wheel"),)

    @property
    def channels(self):
        return (Channel("distance", "m"),)

    def measure(self, view, inputs):
        return [view.position[0] * inputs["wheel"]]

    def residual(self, reading, predicted):
        return independent([reading.values[0] - predicted[0]], [0.1], reading.seen)


def _recording(readings, inputs=None, **numbers):
    return tw.Recording(TIMES, readings, inputs or {}, **numbers)


def _ranges(**changed):
    """A recording of ranges with some of its inputs changed, or left out where they are None."""
    whole = tw.uwb_imu.range_recording(TIMES, DISTANCES, ANCHORS)
    inputs = {name: x for name, x in (dict(whole.inputs) | changed).items() if x is not None}
    return tw.Recording(whole.times, whole.readings, inputs, name="lab")


FOLDER = tw.simulate.agv(n=1, seed=1, rows=10)
FIXES = tw.Readings(PATH, np.ones(PATH.shape, bool))
NAMES: dict[str, Any] = {
    **{name: getattr(module, name) for module in (tw.aoa, tw.baselines, tw.uwb_imu) for name in module.__all__},
    "tw": tw,
    "np": np,
    "station": STATIONS["1"],
    "stations": STATIONS,
    "times": TIMES,
    "path": PATH,
    "anchors": ANCHORS,
    "distances": DISTANCES,
    "phases": PHASES,
    "ranges": tw.uwb_imu.range_recording(TIMES, DISTANCES, ANCHORS, name="lab"),
    "fixes": tw.baselines.fix_recording(TIMES, PATH, name="hall"),
    "all_phases": tw.aoa.phase_recording(TIMES, dict.fromkeys(STATIONS, PHASES), name="station"),
    "folder": FOLDER.folder(),
    "table": pl.DataFrame({"t_s": TIMES, "x_m": PATH[:, 0]}),
    "changed": _ranges,
    "recording": _recording,
    "readings": FIXES,
    "car": tw.Tracker(Car(), {"fixes": tw.parts.FixSensor(0.1, 0.1)}, Parked()),
    "misspelt": tw.Tracker(Car(), {"fixes": tw.parts.FixSensor(0.1, 0.1)}, ParkedAtFix()),
    "declared": tw.Tracker(Car(), {"wheel": Odometer()}, Parked()),
    "turns": tw.Readings(np.zeros((ROWS, 1)), np.ones((ROWS, 1), bool)),
}

MISTAKES = [
    ("fix_tracker().run('my-folder')", "found str; expected a Recording", "`folder = tw.read(path)`"),
    ("fix_tracker().run(folder)", "found RecordingFolder; expected a Recording", "`tw.tracker_for(folder)`"),
    ("fix_tracker().run(table)", "found DataFrame; expected a Recording", "a recording of its columns"),
    ("fix_tracker().run(path)", "found ndarray; expected a Recording", "by `fix_rec"),
    (
        "tw.tracker_for(folder).run(fixes)",
        "found Recording; expected one or more recording folders",
        "`range_tracker(4",
    ),
    (
        "beam_tracker(station, '1').run(phase_recording(times, {'phases': phases}))",
        "found readings of phases; expected '1', which sensor '1' (PlanePhases) reads",
    ),
    (
        "beam_tracker(station, '1').run(phase_recording(times, {'1': phases[:, :7]}))",
        "readings['1'] has 7 channels; expected the 8 of sensor '1' (PlanePhases), phase_1 … phase_8, rad",
    ),
    ("trilateration_tracker().run(ranges)", "readings['ranges'] has 1 channel; expected the 3 of Trilateration"),
    (
        "fix_tracker().run(recording({'fixes': tw.Readings(path, path > 0, np.full((30, 2), 0.1))}))",
        "readings['fixes'].reported has 2 columns; expected the 3 of sensor 'fixes' (FixSensor), variance_x, variance_y",
    ),
    ("fix_tracker().run([fixes, ranges])", "recording 0 ('hall') and missing in recording 1 ('lab')"),
    ("range_tracker(4, planar=True).run(ranges)", "recording 'lab': no input 'height', found anchors, anchor,"),
    ("direct_tracker(stations, planar=True).run(all_phases)", "recording 'station': no input 'height'"),
    (
        "range_tracker(2).run(ranges)",
        "is 3 in a row; expected 0 to 1, since sensor 'ranges' (RangeSensor) is built for 2",
    ),
    ("range_tracker(4).run(changed(nearby=None))", "no input 'nearby'", "which the start (BiasedStart) reads"),
    (
        "range_tracker(4).run(changed(anchors=np.tile(anchors.ravel(), (120, 1))))",
        "inputs['anchors'] has rows of shape (12,); expected rows of shape (3,) m, x, y, z of the anchor of each slot",
    ),
    ("inertial_tracker(4).run(ranges)", "no input 'accel'", "which the motion (Strapdown) reads"),
    (
        "declared.run(recording({'wheel': turns}))",
        "no input 'wheel', found none; expected one number per row, m, the rad",
    ),
    ("misspelt.run(recording({'fixes': readings}))", "expected 'fix', which the start (ParkedAtFix) reads"),
    (
        "car.run(recording({'fixes': readings}))",
        "the view of Car has position; expected 'velocity', which sensor 'fixes'",
    ),
    (
        "fix_tracker().run(tw.stack([fixes])._replace(inputs={'height': np.ones(1)}))",
        "inputs['height'] has shape (1,); expected (30, …, 1), rows first and trajectories last as `dt`",
    ),
    ("tw.Smoothed(fix_tracker()).run(ranges)", "recording 'lab': found readings of ranges; expected 'fixes'"),
    ("tw.fit(tw.tracker_for(folder), fixes, 'nll')", "found Recording; expected one or more recording folders"),
    ("tw.fit(fixes, fix_tracker(), 'nll')", "fit: found Recording for the tracker; expected a tracker"),
    ("tw.fit(fix_tracker(), fixes, 'rmes')", "'rmes' is no objective; expected one of nll, "),
    ("tw.fit(fix_tracker(), fixes, 'rmse')", "the recordings have no known truth; expected some, which"),
]


@pytest.fixture
def _no_tracing(monkeypatch):
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a scan was traced")

    _ranges()  # what a recording of ranges is made with is traced before
    monkeypatch.setattr(jax.lax, "scan", refuse)


@pytest.mark.usefixtures("_no_tracing")
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda m: m[0])
def test_a_mistake_is_refused_in_one_sentence_before_anything_is_traced(mistake):
    code, *words = mistake
    with pytest.raises(tw.UnusableInput) as refused:
        eval(code, NAMES)
    sentence = str(refused.value)
    assert isinstance(refused.value, ValueError)
    assert "\n" not in sentence
    assert "--" not in sentence
    for word in words:
        assert word in sentence


@pytest.mark.slow
def test_one_recording_several_and_a_batch_are_fitted_alike():
    recording = tw.baselines.fix_recording(TIMES, PATH + 0.1 * np.random.default_rng(0).normal(size=PATH.shape))
    tracker, options = tw.baselines.fix_tracker(dof=None), tw.FitOptions(steps=2)
    alike = [recording, [recording], (r for r in [recording]), stack([recording]), [stack([recording])]]
    values = [tw.fit(tracker, given, "nll", "sensors.fixes.sigma_horizontal", options).value for given in alike]
    assert values == [values[0]] * len(alike)
