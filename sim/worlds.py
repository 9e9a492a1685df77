"""Worlds by name, with sensible defaults, each a function: `WORLDS` has them all.

Each takes `n`, the number of trajectories, and `seed`, and gives a `SimulatedWorld` of as many tags. Trajectories have
the ids 0 … n − 1, or `ids`, which replaces `n`. A trajectory depends on the seed and its id alone: the same
seed gives the same numbers whatever other trajectories are simulated.

The signatures here are the only declaration of the worlds' parameters: the options of `trackwright simulate…` and the
keys of `[worlds.NAME]` in a study are made of them, and `checked` holds arguments to their annotations. What simulates
is imported when a world is called, so that they can be listed at once.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial, wraps
from numbers import Integral, Real
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, ParamSpec, get_args, get_origin, get_type_hints

from trackwright import sim

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Int

    from trackwright.sim.corruptions import Corruption
    from trackwright.sim.tables import AbstractDraw, SimulatedWorld
    from trackwright.trackers.recordings.folder import RecordingFolder

__all__ = ["WORLDS", "agv", "body", "fusion", "line", "ranges", "station", "tdoa", "tool"]

P = ParamSpec("P")


@dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`, without `high` itself where `open`."""

    low: float
    high: float
    open: bool = False

    def __str__(self) -> str:
        return f"from {self.low:g} to {'below ' if self.open else ''}{self.high:g}"


class ParameterError(ValueError):
    """An argument of a world outside its range or choices: the parameter's `name`, the `value`, what was `expected`."""

    def __init__(self, name: str, value: Any, expected: str) -> None:
        super().__init__(f"{name} = {value!r}: expected {expected}")
        self.name, self.value, self.expected = name, value, expected


def checked(world: Callable[P, SimulatedWorld]) -> Callable[P, SimulatedWorld]:
    """The function with its arguments checked against their annotations before the call.

    It raises TypeError for an unknown parameter, ParameterError for a value outside its range or choices.
    """
    # The name of what a world gives is imported by type checkers alone.
    hints = get_type_hints(world, localns={"SimulatedWorld": Any}, include_extras=True)
    signature = inspect.signature(world)

    @wraps(world)
    def call(*args: P.args, **kwargs: P.kwargs) -> SimulatedWorld:
        refuse_unknown(kwargs, signature.parameters)
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            kind, *allowed = get_args(hints[name]) or (hints[name],)
            if get_origin(hints[name]) is Literal and value not in get_args(hints[name]):
                raise ParameterError(name, value, f"one of {', '.join(get_args(hints[name]))}")
            # A traced level has no value to check.
            for of in (x for x in allowed if isinstance(x, Range) and not hasattr(value, "aval")):
                number = isinstance(value, Integral if kind is int else Real) and not isinstance(value, bool)
                if not (number and of.low <= value <= of.high) or (of.open and value == of.high):
                    raise ParameterError(name, value, f"a {'whole ' if kind is int else ''}number {of}")
        return world(*args, **kwargs)

    call.__annotations__ = hints
    return call


def refuse_unknown(names: Iterable[str], parameters: Iterable[str]) -> None:
    """Raises TypeError for the first of the names that is no parameter."""
    if unknown := [name for name in names if name not in parameters]:
        raise TypeError(f"parameter '{unknown[0]}' is unknown; expected one of {', '.join(parameters)}")


Trajectories = Annotated[int, Range(1, 10**7)]
Seed = Annotated[int, Range(0, 2**63 - 1)]
Rows = Annotated[int, Range(1, 10**7)]
Rate = Annotated[float, Range(0.1, 1000.0)]
Level = Annotated[float, Range(0.0, 10.0)]
Hidden = Annotated[float, Range(0.0, 0.9)]
Share = Annotated[float, Range(0.0, 0.99)]
Ids = Collection[int] | None


@checked
def station(
    n: Trajectories = 100,
    seed: Seed = 0,
    *,
    path: Literal["helix", "hand"] = "hand",
    rows: Rows = 200,
    rate_hz: Annotated[float, Range(1e-3, 1e6)] = 10.0,
    sigma_p: Annotated[float, Range(0.0, 100.0)] = 0.2,
    outliers: Annotated[float, Range(0.0, 1.0, open=True)] = 0.0,
    drop_outs: Annotated[float, Range(0.0, 1.0, open=True)] = 0.0,
    gauss_markov: Annotated[float, Range(0.0, 100.0)] = 0.0,
    lost_station: str | None = None,
    masked_antenna: tuple[str, int] | None = None,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate beacons at the 24 GHz work station: phases at three stations of eight antennas, with truth.

    Args:
        path: the paper's helix, or random hand motion.
        rows: measurements per trajectory.
        rate_hz: measurements per second.
        sigma_p: white phase noise, rad.
        outliers: probability that a phase is an outlier.
        drop_outs: probability that a station's row is missing.
        gauss_markov: standard deviation of slowly varying phase errors, rad, with a time constant of 1 s.
        lost_station: a station (1, 2 or 3) without any measurement.
        masked_antenna: a station and one of its antennas (1 … 8) without any measurement.
    """
    rig = sim.work_station()
    errors = _present(
        {"gauss-markov": (sim.gauss_markov, gauss_markov, 1.0), "outliers": (sim.outliers, outliers, math.pi),
         "drop-outs": (sim.drop_outs, drop_outs)}
    )  # fmt: skip
    if lost_station is not None:
        if lost_station not in rig.stations:
            raise ParameterError("lost_station", lost_station, "one of the stations 1, 2 and 3")
        errors["lost station"] = sim.lose_station(int(lost_station) - 1)
    if masked_antenna is not None:
        name, antenna = masked_antenna
        if name not in rig.stations or not 1 <= antenna <= 8:
            raise ParameterError("masked_antenna", masked_antenna, "a station, 1 to 3, and an antenna, 1 to 8")
        errors["masked antenna"] = sim.mask_antenna(int(name) - 1, antenna - 1)
    return _drawn(path, sim.PhaseDraw(rig, path, errors, rate_hz, rows, sigma_p), n, seed, ids)


@checked
def line(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    situation: Literal["constant", "halts", "speeds"] = "halts",
    speed: Annotated[float, Range(0.01, 10.0)] = 0.3,
    rate_hz: Rate = 5.0,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate tags on the assembly line: fixes along a known path, with truth.

    Args:
        situation: constant speed, halts where segments meet, or another speed on every segment.
        speed: mean speed along the line, m/s.
        rate_hz: fixes per second.
    """
    return _drawn(f"line-{situation}", sim.LineDraw(situation, speed=speed, rate_hz=rate_hz), n, seed, ids)


@checked
def ranges(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    rows: Rows = 200,
    rate_hz: Rate = 10.0,
    sigma_r: Level = 0.05,
    bias: Level = 0.05,
    hidden: Hidden = 0.1,
    lost: Share = 0.1,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate hand-held UWB tags in a room with four anchors: ranges, with truth.

    Args:
        rows: times at which all anchors are ranged.
        rate_hz: times per second.
        sigma_r: white noise of a range, m, beside the 25 mm of two-way ranging.
        bias: standard deviation of the anchors' constant biases, m.
        hidden: share of the time for which an anchor has no line of sight, and its ranges are too long.
        lost: share of the ranges that are missing.
    """
    errors = _errors_of_anchors(bias, 0.0, hidden, sigma_r, lost)
    return _drawn("ranges", sim.RangeDraw(sim.chamber(), sim.WALK, errors, rate_hz, rows), n, seed, ids)


@checked
def tdoa(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    schedule: Literal["messages", "turns"] = "messages",
    imu: bool = False,
    rows: Rows = 200,
    rate_hz: Rate = 10.0,
    sigma_d: Level = 0.1,
    bias: Level = 0.05,
    drift: Level = 0.05,
    hidden: Hidden = 0.1,
    lost: Share = 0.1,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate hand-held UWB tags in a room with eight synchronised anchors: range differences (TDoA), with truth.

    Args:
        schedule: at each time the differences of all anchors heard from the first, or one, of neighbours in turn.
        imu: whether the tags have an IMU, sampled 100 times per second; it leaves the other numbers as they are.
        rows: times of measurement.
        rate_hz: times per second.
        sigma_d: white noise of a difference, m.
        bias: standard deviation of the anchors' constant clock offsets, m.
        drift: standard deviation of their clock errors that last for 10 s, m.
        hidden: share of the time for which an anchor has no line of sight, and its signal is late.
        lost: share of an anchor's signals that are lost.
    """
    from trackwright.sim.ranging import CORNERS

    # A difference has the noise of two arrivals.
    errors = _errors_of_anchors(bias, drift, hidden, sigma_d / 2**0.5, lost)
    draw = sim.DifferenceDraw(sim.chamber(CORNERS), sim.WALK, errors, rate_hz, rows, schedule)
    return _drawn("tdoa", sim.ImuDraw(draw, imu_hz=100.0) if imu else draw, n, seed, ids)


@checked
def fusion(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    stations: Annotated[int, Range(1, 4)] = 2,
    rows: Rows = 200,
    rate_hz: Rate = 10.0,
    sigma_r: Level = 0.05,
    bias: Level = 0.05,
    hidden: Hidden = 0.1,
    sigma_angle: Annotated[float, Range(0.0, 3.0)] = 0.05,
    bias_angle: Annotated[float, Range(0.0, 3.0)] = 0.1,
    lost: Share = 0.1,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate hand-held UWB tags in a room with four anchors: ranges, and angles at some of them, with truth.

    Args:
        stations: anchors that measure angles.
        rows: times of measurement.
        rate_hz: times per second.
        sigma_r: white noise of a range, m, beside the 25 mm of two-way ranging.
        bias: standard deviation of the anchors' constant biases, m.
        hidden: share of the time for which an anchor has no line of sight, and its ranges are too long.
        sigma_angle: white noise of azimuth and elevation, rad.
        bias_angle: standard deviation of errors of azimuth and elevation that last for 5 s, rad.
        lost: share of the ranges and of the angles that are missing.
    """
    from trackwright.sim.paths import WALK_VOLUME
    from trackwright.sim.stations import with_stations

    rig = with_stations(sim.chamber(), WALK_VOLUME.mean(axis=0), stations)
    errors = _errors_of_anchors(bias, 0.0, hidden, sigma_r, lost)
    of_angles = _present(
        {"drift": (sim.gauss_markov, bias_angle, 5.0), "white": (sim.white_noise, sigma_angle),
         "lost": (sim.drop_outs, lost)}
    )  # fmt: skip
    draw = sim.RangeDraw(rig, sim.WALK, errors, rate_hz, rows)
    return _drawn("fusion", sim.FusionDraw(draw, of_angles), n, seed, ids)


def _errors_of_anchors(bias: float, drift: float, hidden: float, sigma: float, lost: float) -> dict[str, Corruption]:
    """The errors of distances to anchors, m, and the shares of hidden and lost ones, as of `ranges` and `tdoa`."""
    return _present(
        {"biases": (sim.antenna_biases, bias), "drift": (sim.gauss_markov, drift, 10.0),
         "hidden": (sim.obstruction, hidden, 2.0, 0.3, 0.3), "white": (sim.white_noise, sigma),
         "lost": (sim.drop_outs, lost)}
    )  # fmt: skip


def _present(levels: Mapping[str, tuple[Any, ...]]) -> dict[str, Corruption]:
    """The corruptions by name, each given as its maker, its level and further numbers, whose level is above zero."""
    there = {name: of for name, of in levels.items() if hasattr(of[1], "aval") or of[1] > 0}
    return {name: make(level, *more) for name, (make, level, *more) in there.items()}


@checked
def body(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    tags: Annotated[int, Range(1, 3)] = 3,
    odometry: bool = False,
    rows: Annotated[int, Range(3, 10**7)] = 200,
    rate_hz: Rate = 10.0,
    sigma_r: Level = 0.05,
    bias: Level = 0.05,
    hidden: Hidden = 0.1,
    sigma_slip: Level = 0.01,
    sigma_yaw_rate: Level = 0.04,
    lost: Share = 0.1,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate trolleys with UWB tags in a room with four anchors: ranges, and wheel odometry on request, with truth.

    Args:
        tags: tags on each trolley.
        odometry: whether the wheels are measured.
        rows: times at which all tags range to all anchors.
        rate_hz: times per second.
        sigma_r: white noise of a range, m.
        bias: standard deviation of the anchors' constant biases, m.
        hidden: share of the time for which an anchor has no line of sight, and its ranges are too long.
        sigma_slip: white noise of the measured speed, m/s per √Hz.
        sigma_yaw_rate: white noise of the measured turning rate, rad/s per √Hz.
        lost: share of the ranges that are missing.
    """
    of_anchors = _errors_of_anchors(bias, 0.0, hidden, 0.0, 0.0)
    of_ranges = _errors_of_anchors(0.0, 0.0, 0.0, sigma_r, lost)
    wheels = (sigma_slip, sigma_yaw_rate) if odometry else None
    draw = sim.TrolleyDraw(sim.chamber(), tags, rate_hz, rows, of_anchors, of_ranges, wheels)
    return _drawn("body", draw, n, seed, ids)


@checked
def tool(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    rows: Annotated[int, Range(2, 10**7)] = 800,
    rate_hz: Annotated[float, Range(1.0, 1000.0)] = 40.0,
    gap: tuple[float, float] | None = None,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate hand tools with a UWB tag and an IMU: ranges and IMU samples, with truth.

    Args:
        rows: ranges per tag, to one anchor after the other.
        rate_hz: ranges per second; the rate of IMU samples is three times as high.
        gap: start and end of a gap in the IMU's samples, s.
    """
    if gap is not None and not 0 <= gap[0] < gap[1]:
        raise ParameterError("gap", gap, "two times in seconds, the first before the second")
    draw = sim.RangeDraw(sim.chamber(), sim.WALK, {"turn": sim.round_robin()}, rate_hz, rows)
    return _drawn("imu", sim.ImuDraw(draw, gap_s=None if gap is None else (gap[0], gap[1])), n, seed, ids)


@checked
def agv(
    n: Trajectories = 20,
    seed: Seed = 0,
    *,
    rows: Rows = 2000,
    speed: Annotated[float, Range(0.01, 1.41)] = 0.5,
    wild: Share = 0.0,
    latency: Annotated[float, Range(0.0, 10.0)] = 0.0,
    mirror: Share = 0.0,
    ids: Ids = None,
) -> SimulatedWorld:
    """Simulate vehicles on a route round a workstation: UWB fixes that drift, with truth.

    Args:
        rows: fixes per tag, 10 per second.
        speed: speed along the route, m/s.
        wild: probability that a fix is an outlier.
        latency: delay of the fixes, s.
        mirror: share of the time for which heights are mirrored at the anchors' plane.
    """
    from trackwright.sim.agv import ANCHOR_HEIGHT, FIX_ERRORS

    mirrored = partial(sim.mirrored_heights, ANCHOR_HEIGHT)
    # Corruptions that depend on the true path come before those that add noise.
    errors = _present({"late": (sim.delayed, latency), "mirrored": (mirrored, mirror, 3.0)})
    errors |= {**FIX_ERRORS, **_present({"wild": (sim.outliers, wild, 2.0)})}
    return _drawn("agv", sim.VehicleDraw(errors, speed=speed, rows=rows), n, seed, ids)


def _drawn(name: str, draw: AbstractDraw, n: int, seed: int, ids: Ids) -> SimulatedWorld:
    """The world of `n` trajectories or of those with these ids, with the name of its folder."""
    return draw.drawn(n if ids is None else list(ids), seed, f"simulated-{name}-{seed}")


def _folder(
    world: Callable[..., SimulatedWorld], ids: Int[np.ndarray, " n"], seed: int, /, **numbers: Any
) -> RecordingFolder:
    """A world as studies call it; raises TypeError for an unknown parameter, ParameterError for an invalid value."""
    refuse_unknown(numbers, [name for name in inspect.signature(world).parameters if name not in ("n", "seed", "ids")])
    return world(seed=seed, ids=ids, **numbers).folder()


WORLDS: Mapping[str, Callable[..., RecordingFolder]] = MappingProxyType(
    {world.__name__: partial(_folder, world) for world in (station, line, ranges, tdoa, fusion, body, tool, agv)}
)
"""`make(ids, seed, **numbers)`, a recording folder, by the name of the world in a study."""
