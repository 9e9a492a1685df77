"""Mistakes of a Python user are refused before anything is traced, each in one sentence with the usual fix."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.aoa.cascade import cascade_tracker
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
    """Reads an input that it does not declare."""

    @property
    def channels(self):
        return (Channel("distance", "m"),)

    def measure(self, view, inputs):
        return [view.position[0] * inputs["wheel"]]

    def residual(self, reading, predicted):
        return independent([reading.values[0] - predicted[0]], [0.1], reading.seen)


class DeclaredOdometer(Odometer):
    """Declares the input."""

    @property
    def inputs(self):
        return (Input("wheel", (), "m", "the radius of the wheel"),)


def _recording(readings, inputs=None, **numbers):
    return tw.Recording(TIMES, readings, inputs or {}, **numbers)


def _ranges(**changed):
    """A recording of ranges with some of its inputs changed, or left out where they are None."""
    whole = tw.range_recording(TIMES, DISTANCES, ANCHORS)
    inputs = {name: x for name, x in (dict(whole.inputs) | changed).items() if x is not None}
    return tw.Recording(whole.times, whole.readings, inputs, name="lab")


FOLDER = tw.simulate.agv(n=1, seed=1, rows=10)
FIXES = tw.Readings(PATH, np.ones(PATH.shape, bool))
NAMES: dict[str, Any] = {
    "tw": tw,
    "np": np,
    "station": STATIONS["1"],
    "five": replace(STATIONS["1"], antennas=STATIONS["1"].antennas[:5]),
    "stations": STATIONS,
    "times": TIMES,
    "path": PATH,
    "anchors": ANCHORS,
    "distances": DISTANCES,
    "phases": PHASES,
    "ranges": tw.range_recording(TIMES, DISTANCES, ANCHORS, name="lab"),
    "fixes": tw.fix_recording(TIMES, PATH, name="hall"),
    "all_phases": tw.phase_recording(TIMES, dict.fromkeys(STATIONS, PHASES), name="station"),
    "world": FOLDER,
    "folder": FOLDER.folder(),
    "table": pl.DataFrame({"t_s": TIMES, "x_m": PATH[:, 0]}),
    "changed": _ranges,
    "recording": _recording,
    "readings": FIXES,
    "car": tw.Tracker(Car(), {"fixes": tw.FixSensor(0.1, 0.1)}, Parked()),
    "misspelt": tw.Tracker(Car(), {"fixes": tw.FixSensor(0.1, 0.1)}, ParkedAtFix()),
    "odometer": tw.Tracker(Car(), {"wheel": Odometer()}, Parked()),
    "declared": tw.Tracker(Car(), {"wheel": DeclaredOdometer()}, Parked()),
    "turns": tw.Readings(np.zeros((ROWS, 1)), np.ones((ROWS, 1), bool)),
    "cascade_tracker": cascade_tracker,
}

MISTAKES = [
    # the kind of the argument
    (
        "tw.fix_tracker().run('my-folder')",
        "run: found str; expected a Recording",
        "usual fix: `folder = tw.read(path)`",
    ),
    ("tw.fix_tracker().run(folder)", "run: found RecordingFolder; expected a Recording", "`tw.tracker_for(folder)`"),
    ("tw.fix_tracker().run(table)", "run: found DataFrame; expected a Recording", "a recording of its columns"),
    ("tw.fix_tracker().run(path)", "run: found ndarray; expected a Recording", "a recording of arrays, by `fix_rec"),
    (
        "tw.tracker_for(folder).run(fixes)",
        "found Recording; expected one or more recording folders",
        "`range_tracker(4",
    ),
    # readings
    (
        "tw.beam_tracker(station, '1').run(tw.phase_recording(times, {'phases': phases}))",
        "recording 'recording': found readings of phases; expected '1', which sensor '1' (PlanePhases) reads",
        "usual fix: give the readings the name of the sensor, or run a tracker",
    ),
    (
        "tw.beam_tracker(station, '1').run(tw.phase_recording(times, {'1': phases[:, :7]}))",
        "readings['1'] has 7 channels; expected the 8 of sensor '1' (PlanePhases), phase_1 … phase_8, rad",
        "usual fix: one column per channel, with seen = False where a value is missing",
    ),
    (
        "tw.trilateration_tracker().run(ranges)",
        "recording 'lab': readings['ranges'] has 1 channel; expected the 3 of Trilateration, range_1, range_2, range_3",
    ),
    (
        "tw.fix_tracker().run(recording({'fixes': tw.Readings(path, path > 0, np.full((30, 2), 0.1))}))",
        "readings['fixes'].reported has 2 columns; expected the 3 of sensor 'fixes' (FixSensor), variance_x, variance_y",
        "usual fix: the square of each standard deviation, or leave `reported` out",
    ),
    (
        "tw.fix_tracker().run([fixes, ranges])",
        "the recordings differ: readings['fixes'] is of 3 channels with 3 reported columns in recording 0 ('hall') and "
        "missing in recording 1 ('lab'); expected the same names and shapes in all of them",
        "usual fix: make all by the same helper with the same arguments",
    ),
    # inputs
    (
        "tw.range_tracker(4, planar=True).run(ranges)",
        "recording 'lab': no input 'height', found anchors, anchor, nearby, height_limits, room; expected one number per row, m, the known height",
        "which sensor 'ranges' (RangeSensor) reads for a planar state; usual fix: make it by `height=` of `fix_recording`",
    ),
    (
        "tw.direct_tracker(stations, planar=True).run(all_phases)",
        "recording 'station': no input 'height'",
        "which sensor '1' (SphericalPhases) reads for a planar state",
    ),
    (
        "tw.range_tracker(2).run(ranges)",
        "inputs['anchor'], the number of the anchor of each slot, from 0, is 3 in a row; expected 0 to 1, since "
        "sensor 'ranges' (RangeSensor) is built for 2",
        "usual fix: build the tracker for 4",
    ),
    (
        "tw.range_tracker(4).run(changed(nearby=None))",
        "no input 'nearby', found anchors, anchor, height_limits, room; expected rows of shape (4,) m, a position from recent measurements",
        "which the start (BiasedStart) reads; usual fix: make it by `range_recording`",
    ),
    (
        "tw.range_tracker(4).run(changed(anchors=np.tile(anchors.ravel(), (120, 1))))",
        "inputs['anchors'] has rows of shape (12,); expected rows of shape (3,) m, x, y, z of the anchor of each slot",
        "usual fix: make it by `range_recording(anchors=)`",
    ),
    (
        "tw.inertial_tracker(4).run(ranges)",
        "no input 'accel', found anchors, anchor, nearby, height_limits, room; expected rows of shape (3,) m/s^2, specific force in body axes",
        "which the motion (Strapdown) reads; usual fix: make it by `tw.build('uwb-imu', folder)`",
    ),
    (
        "declared.run(recording({'wheel': turns}))",
        "no input 'wheel', found none; expected one number per row, m, the radius of the wheel, which sensor 'wheel'",
        "usual fix: add it to the recording's `inputs`",
    ),
    (
        "misspelt.run(recording({'fixes': readings}))",
        "found readings of fixes; expected 'fix', which the start (ParkedAtFix) reads; usual fix: give the readings",
    ),
    # the view of the motion
    (
        "car.run(recording({'fixes': readings}))",
        "the view of Car has position; expected 'velocity', which sensor 'fixes' (FixSensor) reads",
        "usual fix: a motion whose state has 'velocity', or whose `view` computes it",
    ),
    # batches
    (
        "tw.fix_tracker().run(tw.stack([fixes])._replace(inputs={'height': np.ones(1)}))",
        "the batch: inputs['height'] has shape (1,); expected (30, …, 1), rows first and trajectories last as `dt`",
    ),
    # smoothed trackers, and fits
    (
        "tw.Smoothed(tw.fix_tracker()).run(ranges)",
        "recording 'lab': found readings of ranges; expected 'fixes', which sensor 'fixes' (FixSensor) reads",
    ),
    ("tw.fit(tw.tracker_for(folder), fixes, 'nll')", "found Recording; expected one or more recording folders"),
    ("tw.fit(fixes, tw.fix_tracker(), 'nll')", "fit: found Recording for the tracker; expected a tracker", "usual fix"),
    ("tw.fit(tw.fix_tracker(), fixes, 'rmes')", "objective rmes: 'rmes' is no objective; expected some of nll, "),
    (
        "tw.fit(tw.fix_tracker(), fixes, 'nll+0.1*rmse')",
        "fit: the recordings have no known truth; expected some, which the objective nll+0.1*rmse needs",
        "usual fix: `truth=` where the recordings are made, or the objective nll",
    ),
]


@pytest.fixture
def _no_tracing(monkeypatch):
    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("a scan was traced")

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
    recording = tw.fix_recording(TIMES, PATH + 0.1 * np.random.default_rng(0).normal(size=PATH.shape))
    tracker, options = tw.fix_tracker(dof=None), tw.FitOptions(steps=2)
    alike = [recording, [recording], (r for r in [recording]), stack([recording]), [stack([recording])]]
    values = [tw.fit(tracker, given, "nll", "sensors.fixes.sigma_horizontal", options).value for given in alike]
    assert values == [values[0]] * len(alike)


def test_fixes_without_z_need_no_height():
    flat = tw.fix_recording(TIMES, PATH[:, :2])
    estimates = tw.fix_tracker(planar=True).run(flat)
    np.testing.assert_allclose(np.asarray(estimates.mean.position[0])[-1], PATH[-1, 0], atol=0.2)


FLAT = tw.Kinematic(Vector(1.0, 2.0), Vector(0.1, 0.2))


@pytest.mark.parametrize(
    ("sensor", "view", "inputs", "message"),
    [
        (tw.FixSensor(0.1, 0.1), FLAT, {}, "MissingInputError: 'height'"),
        (
            tw.FixSensor(0.1, 0.1),
            Place(Vector(1.0, 2.0, 0.0)),
            {},
            "has no attribute 'velocity'",
        ),
        (Odometer(), Place(Vector(1.0, 2.0)), {}, "MissingInputError: 'wheel'"),
    ],
)
def test_a_check_of_a_sensor_names_a_missing_input(sensor, view, inputs, message):
    with pytest.raises(tw.BrokenContract) as refused:
        tw.sensor_checks(sensor, view, inputs)[0]()
    assert message in str(refused.value)
