"""Every motion, sensor, filter and start, and every ready tracker, once, in small recordings of one installation.

`CASES`: trackers with recordings of `TAGS` tags and at most `ROWS` rows, to which the identities of
`test_identities.py` apply. `MOTIONS` and `SENSORS`: parts at one state, to which their contracts apply
(`test_contracts.py`). `test_catalogue.py` fails for a class that is missing here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import polars as pl

from tests.known_start import KnownStart, Still
from trackwright.sim.stations import facing
from trackwright.trackers.aoa.beam import Beam, BeamMotion, InPlaneBeam, InPlaneBeamMotion
from trackwright.trackers.aoa.cascade import cascade_tracker
from trackwright.trackers.aoa.fusion import BearingSensor, bearing_inputs
from trackwright.trackers.aoa.mapped_bearings import MappedBearingSensor
from trackwright.trackers.aoa.phases import InPlanePhases, PlanePhases, SphericalPhases
from trackwright.trackers.baselines.fixes import fix_tracker
from trackwright.trackers.baselines.switching import MirrorSensor
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.filters.ekf import ExtendedKalman
from trackwright.trackers.core.filters.imm import SwitchingMotion
from trackwright.trackers.core.filters.particle.filter import ParticleFilter
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import (
    AbstractMotion,
    Accelerated,
    ConstantPosition,
    ConstantVelocity,
    GroundMotion,
    Kinematic,
    Placed,
)
from trackwright.trackers.core.model.polyline import Polyline
from trackwright.trackers.core.model.rig import Rig, Station, Tag
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.model.state import Heading, Rotation
from trackwright.trackers.core.model.tunable import Scale
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.fusion.tracker import FusedMotion, FusedState
from trackwright.trackers.line.motion import HaltingMotion, HaltingState, LineMotion, PathState
from trackwright.trackers.line.tracker import FloorFixes, line_grid_tracker, line_tracker
from trackwright.trackers.linear import linear
from trackwright.trackers.mhk.tracker import STILL, mhk_tracker
from trackwright.trackers.parts.drifting_biases import BiasDrift, BiasedState, DriftingBiases
from trackwright.trackers.parts.fixes import FIXES, CorrelatedFixSensor, FixSensor, FixStart
from trackwright.trackers.parts.ranges import RANGES, RangeSensor
from trackwright.trackers.parts.singer import Singer
from trackwright.trackers.recordings.calibration import UNCALIBRATED, Calibration, floor_grid
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import Trajectory, cut
from trackwright.trackers.uwb_imu.body import BodyState, TurningBody, Wheels
from trackwright.trackers.uwb_imu.fusion import RangeDifferenceSensor
from trackwright.trackers.uwb_imu.inertial import inertial_tracker
from trackwright.trackers.uwb_imu.strapdown import ImuNoise, Inertial, PlanarInertial, PlanarStrapdown, Strapdown

TAGS, ROWS = 8, 64

ANTENNAS = np.array([[-0.022, 0.006], [-0.019, -0.017], [0.030, -0.018], [0.012, 0.020]])
WAVELENGTH = 0.0125
KNOTS = np.array([[1.0, 1.0], [2.0, 1.0], [2.0, 4.0]])
FLOOR = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
CORNERS = {"A1": (0.0, 0.0, 2.4), "A2": (6.0, 0.0, 2.6), "A3": (6.0, 5.0, 2.4), "A4": (0.0, 5.0, 2.5)}
CENTRE = np.array([2.0, 2.0, 1.0])
"""Tags walk along `KNOTS` below four nearly coplanar anchors and between two stations of four antennas each."""


def _station(x: float, y: float, z: float) -> Station:
    position = np.array([x, y, z])
    return Station(position, facing(position, CENTRE, (0.0, 0.0, 1.0)), ANTENNAS, WAVELENGTH)


RIG = Rig(
    "catalogue",
    anchors={name: np.array(position) for name, position in CORNERS.items()},
    stations={"S1": _station(-1.0, 2.5, 2.5), "S2": _station(2.5, 7.0, 2.0)},
    tags={f"{k}": Tag(height=1.0 + 0.05 * k) for k in range(TAGS)},
    path_knots=KNOTS,
    outline=FLOOR,
)
FLAT = {"S1": Station(np.array([-1.0, 2.5, 1.2]), np.array([1.0, 0.0, 0.0, 0.0]), ANTENNAS, WAVELENGTH)}
"""A flat array at the tags' height, for directions in its plane."""


@cache
def folder() -> RecordingFolder:
    """All tables of one recording, by NumPy alone: irregular times, missing values, a silence, a gap of the IMU.

    Fixes and ranges carry standard deviations. Tag 3 is silent for longer than any tracker waits, tag 5 ends early.
    """
    rng = np.random.default_rng(0)
    rows: dict[str, list[dict]] = {name: [] for name in ("fixes", "ranges", "bearings", "phases", "imu", "truth")}
    joins = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(KNOTS, axis=0), axis=1))])
    for k in range(TAGS):
        times = 100.0 * k + np.cumsum(rng.uniform(0.02, 0.1, ROWS))
        times[20] = times[19]
        if k == 3:
            times[30:] += 15.0
        if k == 5:
            times = times[:40]
        # One second at rest, another at the join, and on.
        seconds = np.arange(len(times)) * 0.06
        along = np.interp(seconds, [0.0, 0.6, 1.6, 2.4, 4.0], [0.2, 0.2, 1.0, 1.0, 1.0 + 1.2])
        x, y = (np.interp(along, joins, KNOTS[:, axis]) for axis in (0, 1))
        height = 1.0 + 0.05 * k
        places = np.column_stack([x, y, np.full(len(x), height)])
        for number, (t, position) in enumerate(zip(times, places, strict=True)):
            head = {"t_s": float(t), "tag": f"{k}"}
            axes = dict(zip(("x_m", "y_m", "z_m"), position, strict=True))
            rows["truth"].append(head | axes)
            missing = rng.random(3) < 0.1
            fix = {
                a: None if gone else v + rng.normal(0, 0.1) for (a, v), gone in zip(axes.items(), missing, strict=True)
            }
            rows["fixes"].append(head | fix | {f"{a}_std_m": 0.05 for a in "xyz"})
            anchor = sorted(CORNERS)[number % 4]
            distance = float(np.linalg.norm(position - CORNERS[anchor])) + rng.normal(0, 0.05)
            heard = -1.0 if rng.random() < 0.1 else distance
            rows["ranges"].append(head | {"anchor": anchor, "range_m": heard, "range_std_m": 0.03})
            for name, station in RIG.stations.items():
                exact = station.angles(position) + rng.normal(0, 0.02, 2)
                angles = [None if rng.random() < 0.05 else float(a) for a in exact]
                names = ("azimuth_rad", "elevation_rad")
                if (number + (name == "S2")) % 2:
                    rows["bearings"].append(head | {"station": name} | dict(zip(names, angles, strict=True)))
                exact = -2 * np.pi / WAVELENGTH * np.linalg.norm(position - station.antenna_positions(), axis=1)
                phases = np.angle(np.exp(1j * (exact + rng.uniform(0, 6) + rng.normal(0, 0.1, len(ANTENNAS)))))
                values = [None if rng.random() < 0.05 else float(p) for p in phases]
                columns = {f"phase_{n + 1}_rad": value for n, value in enumerate(values)}
                rows["phases"].append(head | {"station": name} | columns)
            if not 30 <= number < 45:
                accel, gyro = rng.normal((0, 0, 9.81), 0.05), rng.normal(0, 0.01, 3)
                sample = {f"accel_{a}_mps2": v for a, v in zip("xyz", accel, strict=True)}
                rows["imu"].append(head | sample | {f"gyro_{a}_radps": v for a, v in zip("xyz", gyro, strict=True)})
    return RecordingFolder("catalogue", None, RIG, {name: pl.DataFrame(table) for name, table in rows.items()})


@cache
def _of_one_flat_array() -> RecordingFolder:
    """The folder with one station, a flat array at the tags' height."""
    phases = folder().tables["phases"].filter(pl.col("station") == "S1")
    return replace(folder(), rig=replace(RIG, stations=FLAT), tables=folder().tables | {"phases": phases})


@cache
def _of_fixes() -> RecordingFolder:
    """The folder without ranges, which trackers on a path prefer to fixes."""
    return replace(folder(), tables={"fixes": folder().tables["fixes"], "truth": folder().tables["truth"]})


@cache
def _of_all_ranges() -> RecordingFolder:
    """The folder without lost ranges: a place in space needs four in turn."""
    ranges, truth = folder().tables["ranges"], folder().tables["truth"].select("x_m", "y_m", "z_m").to_numpy()
    true = np.linalg.norm(truth - [CORNERS[name] for name in ranges["anchor"]], axis=1)
    heard = np.where(ranges["range_m"] > 0.0, ranges["range_m"], true)
    return replace(folder(), tables=folder().tables | {"ranges": ranges.with_columns(range_m=pl.Series(heard))})


@cache
def _of_differences() -> RecordingFolder:
    """Messages of two to four range differences among five anchors, of which one in ten is missing, and the IMU."""
    anchors, rng, rows = {**RIG.anchors, "A5": np.array([3.0, 2.0, 0.3])}, np.random.default_rng(1), list[dict]()
    for number, row in enumerate(folder().tables["truth"].rows(named=True)):
        place = np.array([row["x_m"], row["y_m"], row["z_m"]])
        arrival = {name: np.linalg.norm(place - anchor) + rng.normal(0, 0.05) for name, anchor in anchors.items()}
        for first, second in [("A1", "A5"), ("A2", "A5"), ("A3", "A4"), ("A4", "A1")][: 2 + number % 3]:
            difference = None if rng.random() < 0.1 else float(arrival[first] - arrival[second])
            pair = {"anchor": first, "anchor_2": second, "range_difference_m": difference}
            rows.append({"t_s": row["t_s"], "tag": row["tag"], **pair, "range_difference_std_m": 0.03})
    tables = {"tdoa": pl.DataFrame(rows), **{name: folder().tables[name] for name in ("imu", "truth")}}
    return replace(folder(), rig=replace(RIG, anchors=anchors), tables=tables)


@cache
def _of_bodies() -> RecordingFolder:
    """Four bodies, of each of which two tags answer in turn."""
    pairs = {k: (f"{k}", f"{(k + 4) % TAGS}") for k in range(2, 6)}
    ranges = folder().tables["ranges"].filter(pl.col("tag").cast(int).is_in(list(pairs)))
    turn = pl.int_range(pl.len()).over("tag") % 2 * 4
    ranges = ranges.with_columns(tag=((pl.col("tag").cast(int) + turn) % TAGS).cast(pl.String))
    tags = {
        name: Tag(RIG.tags[body[0]].height, np.array([0.4 * (name == body[0]), 0.1, 0.0]))
        for body in pairs.values()
        for name in body
    }
    rig = replace(RIG, tags=tags, bodies={f"body {k}": body for k, body in pairs.items()})
    return replace(folder(), rig=rig, tables={"ranges": ranges, "truth": folder().tables["truth"]})


@cache
def _of_wheels() -> RecordingFolder:
    """These bodies on wheels, whose odometry is lacking for a while."""
    rows = [
        {
            "t_s": 100.0 * tag + 0.1 * k,
            "tag": f"{tag}",
            "speed_mps": 0.4 + 0.1 * np.sin(k),
            "yaw_rate_radps": 0.3 * np.cos(0.2 * k),
        }
        for tag in range(2, 6)
        for k in range(60)
        if not 20 <= k < 32 and not (tag == 5 and k > 8)  # which ends early
    ]
    return replace(_of_bodies(), tables={**_of_bodies().tables, "odometry": pl.DataFrame(rows).sort("t_s")})


@cache
def of_a_map() -> RecordingFolder:
    """The folder with a calibration that has a map of the errors of bearings."""
    rng, names = np.random.default_rng(2), RIG.stations
    visits = np.column_stack([rng.uniform(0.5, 3.5, (30, 2)), rng.normal(0.0, [0.1, 0.2], (30, 2))])
    calibration = Calibration(dict.fromkeys(names, UNCALIBRATED), bearing_map=dict.fromkeys(names, visits))
    return folder().calibrated(calibration)


@cache
def trajectories(name: str, free_height: bool, source: Callable[[], RecordingFolder]) -> tuple[Trajectory, ...]:
    """The trajectories of all tags, as the ready tracker of this name reads them from `source()`.

    Beam trackers have one for each station, of which the first station's suffice.
    """
    chosen = [t for t in TRACKERS[name].trajectories(source(), free_height) if t.station in ("", "S1")]
    cuts = [cut(t.recording, 0, min(ROWS, len(t.recording))) for t in chosen]
    return tuple(replace(t, recording=replace(c, id=k)) for k, (t, c) in enumerate(zip(chosen, cuts, strict=True)))


@dataclass(frozen=True)
class Case:
    """A tracker and the recordings that it reads: those of the ready tracker `reads` in the folder `source`.

    `build`: None for the ready tracker itself. `add`: what is done to the recordings. `causal`: estimates do not depend
    on later rows. `smoothable`: they can be smoothed. `draws`: the tracker uses random numbers. `idle`: patterns of
    tunables that change neither likelihood nor error.
    """

    name: str
    reads: str
    build: Callable[[], AbstractTracker] | None = None
    free_height: bool = False
    source: Callable[[], RecordingFolder] = folder
    add: Callable[[Recording], Recording] = lambda recording: recording
    causal: bool = True
    smoothable: bool = True
    draws: bool = False
    idle: tuple[str, ...] = ()

    def tracker(self) -> AbstractTracker:
        """The tracker; a ready one as the command line builds it."""
        if self.build is not None:
            return self.build()
        first, entry = trajectories(self.reads, self.free_height, self.source)[0], TRACKERS[self.reads]
        return entry.build(first, entry.planar(first, self.free_height))

    def recordings(self) -> list[Recording]:
        """One recording per tag, of at most `ROWS` rows."""
        return [self.add(t.recording) for t in trajectories(self.reads, self.free_height, self.source)]


_MHK_IDLE = ("*.reported_std_scale",)  # fixes that become medians lose the variances that the device reported


_GRID_IDLE = ("filter.output_map.sigma_line",)  # the width of the line is part of reported covariances alone

_RESTING_IDLE = ("start.sigma_speed", *_GRID_IDLE)  # a tag that starts at rest has no speed


def _ready_cases() -> Iterator[Case]:
    """Every tracker of `trackers.catalogue`: at the tags' known heights, and in space where that is another tracker."""

    def ready(name: str, **facts: Any) -> Case:
        return Case(name, name, **facts)

    def both(name: str, **facts: Any) -> Iterator[Case]:
        yield ready(name, **facts)
        yield replace(ready(name, **facts), name=f"{name} in space", free_height=True)

    def flat(name: str, **facts: Any) -> Case:
        return Case(f"{name} in the plane of the array", name, source=_of_one_flat_array, **facts)

    yield from both("fix-kf")
    yield from both("fix-singer")
    yield from both("imm")
    yield ready("fix-mirror", idle=("*.floor",))
    yield ready("moving-average", smoothable=False)
    yield ready("median", smoothable=False)
    yield ready("mhk", smoothable=False, idle=_MHK_IDLE)
    yield ready("mhk-stamped", smoothable=False, idle=_MHK_IDLE)
    yield ready("floor-pf", smoothable=False, draws=True)
    yield ready("line-grid", smoothable=False, source=_of_fixes, idle=_RESTING_IDLE)
    yield ready("line-pf", smoothable=False, draws=True)
    yield from both("uwb")
    yield from both("uwb-imu")
    yield from both("body", source=_of_bodies)
    driven = ("start.sigma_rate", "start.sigma_velocity", "motion.place.sigma_z")
    yield replace(ready("body", source=_of_wheels, idle=driven), name="body with odometry")
    yield from both("tdoa", source=_of_differences)
    yield from both("tdoa-imu", source=_of_differences)
    yield from both("fusion", idle=("sensors.bearings.reported_std_scale",))
    yield from both("multilateration", smoothable=False, source=_of_all_ranges)
    yield ready("trilateration", smoothable=False, idle=("sigma_r",))
    yield ready("trilateration-compensated", smoothable=False)
    # No walk of four seconds has a significant speed, and no reading a standard deviation.
    yield from both("bearings", idle=("motion.length", "*.reported_std_scale"))
    mapped = ("motion.sigma_z", "*.reported_std_scale", "*.compression")
    yield Case("bearings with a map", "bearings", source=of_a_map, idle=mapped)
    yield ready("beam")
    yield flat("beam")
    yield ready("das", smoothable=False)
    yield flat("das", smoothable=False)
    yield from both("direct")
    yield ready("cascade", smoothable=False)


def _made_cases() -> Iterator[Case]:
    """Trackers of parts that no ready tracker has together."""

    def made(name: str, reads: str, build: Callable[[], AbstractTracker], **facts: Any) -> Case:
        return Case(name, reads, build, **facts)

    in_space, start = {"free_height": True}, FixStart(Scale(1.0, "m"), Scale(1.0, "m/s"), False, 3)
    moving = {"motion": ConstantVelocity(1.0, 3), "start": start}
    yield made("normal errors", "fix-kf", lambda: replace(fix_tracker(dof=None), **moving), **in_space)
    correlated = {FIXES: CorrelatedFixSensor(STILL)}
    yield made("correlated errors", "fix-kf", lambda: replace(fix_tracker(), sensors=correlated), **in_space)
    few = ParticleFilter(100)
    yield made(
        "particles",
        "fix-kf",
        # Of four components 100 particles report a seventh of the squares of their errors, 1000 nine tenths.
        lambda: replace(fix_tracker(planar=True), filter=ParticleFilter(1000)),
        draws=True,
        smoothable=False,
    )
    yield made("mhk with memory", "mhk", lambda: mhk_tracker(rate=1.0), idle=_MHK_IDLE, smoothable=False)
    paper = partial(cascade_tracker, RIG.stations, paper_form=True)
    yield made("cascade by the paper's form", "cascade", paper, smoothable=False)
    free, halting = partial(LineMotion, sigma_a=0.1), partial(HaltingMotion, sigma_a=0.1)
    on_line, fixes = partial(line_tracker, n_particles=100), {"source": _of_fixes}
    yield made("line-pf without halts", "line-pf", _on_line(on_line, free), draws=True, **fixes, smoothable=False)
    grid: dict[str, Any] = {**fixes, "smoothable": False}
    yield made("line-grid without halts", "line-grid", _on_line(line_grid_tracker, free), idle=_GRID_IDLE, **grid)
    closed = _on_line(line_grid_tracker, halting, closed=True)
    yield made("line-grid, closed", "line-grid", closed, idle=_RESTING_IDLE, **grid)
    walk = Tracker(ConstantPosition(0.5, 2), {FIXES: FloorFixes(0.3, None)}, KnownStart(_place), few)
    yield made("random walk", "line-pf", lambda: walk, add=_from_the_first_knot, draws=True, **fixes, smoothable=False)
    two = {FIXES: FixSensor(0.1, 0.3), RANGES: RangeSensor(1, len(CORNERS), 0.1, 2.0, 4.0)}
    both = partial(replace, fix_tracker(), sensors=two)
    yield made("fixes and ranges", "uwb", both, add=_with_a_fix, **in_space)
    yield made("matrices", "fix-kf", _of_matrices, **in_space)
    single = partial(replace, inertial_tracker(planar=True), filter=ExtendedKalman())
    # On the floor, without biases of ranges.
    idle = ("start.sigma_tilt", "start.sigma_height", "start.sigma_bias", "motion.noise.sigma_range_walk")
    yield made("inertial with a known yaw", "uwb-imu", single, idle=idle)


def _transition(dt: Any) -> Any:
    return jnp.eye(6) + dt * jnp.eye(6, k=3)


def _driven(dt: Any, q: Any) -> Any:
    return q**2 * (dt * jnp.diag(jnp.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.1])) + dt**3 / 12 * jnp.eye(6))


def _of_matrices() -> Tracker:
    """Fixes in space by matrices of a user."""
    return linear(
        _transition,
        {FIXES: np.eye(3, 6)},
        (_driven, {"q": 1.0}),
        {FIXES: np.diag([0.01, 0.02, 0.09])},
        x0=[2.0, 2.0, 1.0, 0.0, 0.0, 0.0],
        P0=4.0 * np.eye(6),
        state={"position": 3, "velocity": 3},
    )


def _on_line(make: Any, motion: Any, closed: bool = False) -> Callable[[], AbstractTracker]:
    knots = np.vstack([KNOTS, KNOTS[:1]]) if closed else KNOTS
    return lambda: make(motion(Polyline(knots)), {FIXES: FloorFixes(0.3)})


def _place(x: Any) -> Placed:
    return Placed(Vector(x[0], x[1]))


def _from_the_first_knot(recording: Recording) -> Recording:
    """The recording with the belief at its first row, for a `KnownStart`."""
    known = {"start_mean": KNOTS[0], "start_cov": np.array([1.0, 0.0, 1.0])}
    tiled = {name: np.tile(x, (len(recording), 1)) for name, x in known.items()}
    return replace(recording, inputs={**recording.inputs, **tiled})


def _with_a_fix(recording: Recording) -> Recording:
    """The rows of ranges of a tag, with the tag's fix at the same time as a second sensor."""
    other = {r.name: r for r in CASES["fix-kf in space"].recordings()}[recording.name]
    return replace(recording, readings={**recording.readings, **other.readings})


def _smoothed_cases(cases: Iterable[Case]) -> Iterator[Case]:
    """Every tracker that can be smoothed, over the whole recording, and one with a fixed lag."""

    def smoothed(case: Case, lag: float | None = None) -> AbstractTracker:
        return Smoothed(case.tracker(), lag)

    for case in cases:
        if case.smoothable:
            later = {"causal": False, "smoothable": False}
            whole, lagged = partial(smoothed, case), partial(smoothed, case, 0.3)
            yield replace(case, name=f"{case.name}, smoothed", build=whole, **later)
            if case.name == "fix-kf":
                yield replace(case, name=f"{case.name}, smoothed with a lag", build=lagged, **later)


_FORWARD = (*_ready_cases(), *_made_cases())
CASES = {case.name: case for case in (*_FORWARD, *_smoothed_cases(_FORWARD))}


@dataclass(frozen=True)
class MotionCase:
    """A motion at one state, with the inputs of a row."""

    motion: AbstractMotion
    state: Any
    inputs: Any = None
    dt: float = 0.1


@dataclass(frozen=True)
class SensorCase:
    """A sensor at one view of a state, with the inputs of a row and the noise that the device reported with it."""

    sensor: AbstractSensor
    view: Any
    inputs: Any = None
    reported: tuple[float, ...] = ()


MOVING = Kinematic(Vector(0.1, 0.2, 0.3), Vector(1.0, -1.0, 0.5))
FLAT_BEAM, BEAM = InPlaneBeam(Heading(0.1), 0.4), Beam(0.1, 0.2, 0.3, 0.4)
LINE = Polyline([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
_IMU = {"accel": np.array([0.8, -1.1, 9.5]), "gyro": np.array([0.3, -0.5, 1.2]), "arm": np.array([0.3, -0.2, 0.1])}
_ATTITUDE = np.array([0.9, 0.2, -0.3, 0.1]) / np.linalg.norm([0.9, 0.2, -0.3, 0.1])
_LEVEL = PlanarInertial(Vector(1.0, 2.0), Vector(0.7, -0.4), Vector(0.1, -0.2), Heading(0.6), 0.05, Vector(0.1))
_SPACE = Inertial(
    Vector(1.0, 2.0, 3.0),
    Vector(0.7, -0.4, 0.2),
    Rotation(*_ATTITUDE),
    Vector(0.1, -0.2, 0.3),
    Vector(0.05, 0.02, -0.1),
    Vector(0.1),
)
_IMU_NOISE = ImuNoise(0.05, 0.01, 0.005, 0.001, 1.0, 0.5)


def _inertial_motions() -> Iterator[tuple[str, MotionCase]]:
    """With both sensors of the IMU, without its accelerometer, and without either."""
    for label, available in {"": (1.0, 1.0), ", no accelerometer": (0.0, 1.0), ", no IMU": (0.0, 0.0)}.items():
        inputs = {**_IMU, "imu": np.array(available)}
        yield f"planar strapdown{label}", MotionCase(PlanarStrapdown(_IMU_NOISE, biases=1), _LEVEL, inputs, 0.02)
        yield f"strapdown{label}", MotionCase(Strapdown(_IMU_NOISE, biases=1), _SPACE, inputs, 0.02)


_COUNTS = {"bearings": 2, "ranges": 1}
_FLOOR_STATE = Kinematic(Vector(0.1, 0.2), Vector(1.0, -1.0))
MOTIONS = {
    "still": MotionCase(Still(), MOVING),
    "constant velocity": MotionCase(ConstantVelocity(1.0, 3), MOVING),
    "constant position": MotionCase(ConstantPosition(1.0, 2), Placed(Vector(0.1, 0.2))),
    "ground": MotionCase(GroundMotion(1.0, 0.1), Kinematic(Vector(0.1, 0.2, 0.3), Vector(1.0, -1.0))),
    "ground at a known height": MotionCase(GroundMotion(1.0, 0.1), _FLOOR_STATE),
    "switching": MotionCase(SwitchingMotion((GroundMotion(1.0, 0.1), GroundMotion(3.0, 0.1))), _FLOOR_STATE),
    "Singer": MotionCase(Singer(1.0, 2.0, 1), Accelerated(Vector(0.1), Vector(-1.0), Vector(2.0))),
    "damped velocity on the floor": MotionCase(
        DriftingBiases(2, 0.3, 0.2, 5.0, 0.05, 20.0, 2.0),
        BiasedState(Vector(0.1, 0.1), Vector(0.2, 0.2), Vector(0.01, -0.02)),
    ),
    "turning body": MotionCase(
        TurningBody(DriftingBiases(2, 0.3, 0.2, 5.0, 0.05, 20.0, 2.0), 0.5, 1.0),
        BodyState(Vector(0.1, 0.1), Heading(0.4), Vector(0.2, 0.2), 0.3, Vector(0.01, -0.02), Vector()),
    ),
    "driven body": MotionCase(
        TurningBody(DriftingBiases(2, 0.3, 0.2, 5.0, 0.05, 20.0, 2.0), 0.5, 1.0, Wheels()),
        BodyState(Vector(0.1, 0.1), Heading(0.4), Vector(0.2, 0.2), 0.3, Vector(0.01, -0.02), Vector()),
        {"odometry": np.array([0.5, 0.4, 1.0]), "arm": np.array([0.3, -0.2, 0.0])},
    ),
    "damped velocity": MotionCase(
        DriftingBiases(2, 0.3, 0.2, 5.0, 0.05, 20.0, 2.0),
        BiasedState(Vector(0.1, 0.1, 0.1), Vector(0.2, 0.2, 0.2), Vector(0.01, -0.02), Vector(0.05)),
    ),
    "damped velocity with biases of two kinds": MotionCase(
        FusedMotion(
            *(Scale(x) for x in (0.3, 0.2, 5.0)),
            {name: BiasDrift(0.05, 20.0, 2.0, biases) for name, biases in _COUNTS.items()},
        ),
        FusedState(
            Vector(0.1, 0.1), Vector(0.2, 0.2), {name: Vector(*[0.01] * n) for name, n in _COUNTS.items()}, Vector(0.05)
        ),
    ),
    "beam": MotionCase(BeamMotion(Scale(1.0)), BEAM),
    "beam in the plane": MotionCase(InPlaneBeamMotion(Scale(1.0)), FLAT_BEAM),
    "line": MotionCase(LineMotion(LINE, 0.1), PathState(3.99, 0.5)),
    "halting, on the way": MotionCase(HaltingMotion(LINE, 0.1), HaltingState(3.99, 0.5, 0.0)),
    "halting, at rest": MotionCase(HaltingMotion(LINE, 0.1), HaltingState(4.0, 0.0, 1.0)),
    "halting anywhere": MotionCase(HaltingMotion(LINE, 0.1, travel=20.0), HaltingState(2.0, 0.5, 0.0)),
    **dict(_inertial_motions()),
    "matrices": MotionCase(_of_matrices().motion, _of_matrices().motion.step(MOVING, {}, 0.1, Vector(*[0.0] * 6))),
}

_S1 = RIG.stations["S1"]
_GEOMETRY = {"origin": bearing_inputs(_S1)[:3], "axes": bearing_inputs(_S1)[3:]}
CALIBRATED = np.array([0.1, 0.7, 0.1, 0.05, -0.1, 1.2, -0.1, 0.02, -1.0, 1.0, -0.5, 0.6])
_VISITS = np.array([[0.5, -2.0, 0.1, -0.2], [1.5, -1.5, -0.1, 0.1]])
_TWO_ANCHORS = {"anchors": np.array([5.0, 0.0, 2.0, 0.0, 6.0, 1.0]), "anchor": np.array([0.0, 1.0])}
_TWO_PAIRS = {"pairs": np.tile(_TWO_ANCHORS["anchors"], 2) + np.arange(12.0), "pair": np.array([0.0, 1.0, 1.0, 2.0])}
_ROOM = Kinematic(Vector(1.0, -2.0, 0.5), Vector(0.3, -0.4))
_MIRROR = MirrorSensor(0.1, 0.3, 0.5, 0.5, 4.0)
SENSORS = {
    "fixes": SensorCase(FixSensor(0.1, 0.3), _ROOM, {}, (0.01, 0.02, 0.03)),
    "fixes with outliers and latency": SensorCase(FixSensor(0.1, 0.3, 4.0, 0.2), _ROOM, {}, (0.01, 0.02, 0.03)),
    "fixes with correlated errors": SensorCase(CorrelatedFixSensor(STILL), _ROOM, {}),
    "fixes below the anchors' plane": SensorCase(_MIRROR.in_mode(0), _ROOM, {"plane": np.array(1.5)}),
    "fixes above the anchors' plane": SensorCase(_MIRROR.in_mode(1), _ROOM, {"plane": np.array(1.5)}),
    "fixes on the floor": SensorCase(FloorFixes(0.3), _ROOM, None, (0.01, 0.02)),
    "fixes on the floor, normal errors": SensorCase(FloorFixes(0.3, None), _ROOM, None, (0.01, 0.02)),
    "ranges": SensorCase(RangeSensor(2, 2, 0.1, 2.0, 4.0), _ROOM, _TWO_ANCHORS),
    "ranges with variances": SensorCase(RangeSensor(2, 2, 0.1, 2.0, 4.0), _ROOM, _TWO_ANCHORS, (0.02, 0.01)),
    "range differences": SensorCase(RangeDifferenceSensor(2, 0.1, 4.0), _ROOM, _TWO_PAIRS),
    "correlated range differences": SensorCase(
        RangeDifferenceSensor(2, 0.1, 4.0), _ROOM, _TWO_PAIRS, (0.02, 0.01, -0.4)
    ),
    "bearings": SensorCase(BearingSensor(0.1, 0.2, 4.0), MOVING, _GEOMETRY),
    "bearings of a calibrated station": SensorCase(
        BearingSensor(0.1, 0.2, 4.0), MOVING, {**_GEOMETRY, "calibration": CALIBRATED}
    ),
    "bearings with variances": SensorCase(BearingSensor(0.1, 0.2, 4.0), MOVING, _GEOMETRY, (0.01, 0.005, 0.02)),
    "bearings with a map": SensorCase(
        MappedBearingSensor(floor_grid({"S1": _VISITS}, ["S1"]), 0.1, 0.2, 4.0),
        MOVING,
        {**_GEOMETRY, "station": np.array(0.0)},
        (0.01, 0.005, 0.02),
    ),
    "plane waves": SensorCase(PlanePhases(_S1, 0.3), BEAM),
    "plane waves in the plane of the array": SensorCase(InPlanePhases(_S1, 0.3), FLAT_BEAM),
    "spherical waves": SensorCase(SphericalPhases(_S1, 0.3), MOVING),
    "matrices": SensorCase(
        _of_matrices().sensors[FIXES],
        Kinematic(Vector(1.0, 2.0, 1.0), Vector(0.7, -0.4, 0.1)),
        None,
        (0.01, 0.02, 0.03),
    ),
}
