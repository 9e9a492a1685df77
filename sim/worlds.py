"""Worlds by name with the numbers a person may set, for `simulate…` and for studies: folders of tags, with truth.

Every world is `make(ids, seed, **numbers)`; a tag is named by its id and depends on the seed and that id alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from sim import agv as vehicles
from sim import corruptions, imu, ranging
from sim.corruptions import Corruption
from sim.fixes import late, mirrored
from sim.line import simulate_line
from sim.scenarios import simulate_phases, work_station
from sim.tables.agv import simulated_agv
from sim.tables.line import simulated_line
from sim.tables.phases import as_folder
from sim.tables.ranging import simulated_ranging
from sim.tables.uwb_imu import simulated_uwb_imu
from trackers.recordings.folder import RecordingFolder

Ids = np.ndarray


def station(
    ids: Ids,
    seed: int,
    path: str = "hand",
    rows: int = 200,
    rate_hz: float = 10.0,
    sigma_p: float = 0.2,
    outliers: float = 0.0,
    drop_outs: float = 0.0,
    gauss_markov: float = 0.0,
    lost_station: str | None = None,
    masked_antenna: tuple[str, int] | None = None,
) -> RecordingFolder:
    """Beacons at the 24 GHz work station of three arrays: phases. What the numbers mean: `trackwright simulate --help`.

    Raises ValueError for a path, station or antenna that isn't there.
    """
    rig = work_station()
    pieces: dict[str, Corruption] = {}
    if gauss_markov > 0:
        pieces["gauss-markov"] = corruptions.gauss_markov(gauss_markov, 1.0)
    if outliers > 0:
        pieces["outliers"] = corruptions.outliers(outliers, np.pi)
    if drop_outs > 0:
        pieces["drop-outs"] = corruptions.drop_outs(drop_outs)
    if lost_station is not None:
        pieces["lost station"] = corruptions.lose_station(_index(list(rig.stations), lost_station, "lost-station"))
    if masked_antenna is not None:
        name, antenna = masked_antenna
        if not 1 <= antenna <= 8:
            raise ValueError(f"masked-antenna {antenna}: expected an antenna from 1 to 8")
        number = _index(list(rig.stations), name, "masked-antenna")
        pieces["masked antenna"] = corruptions.mask_antenna(number, antenna - 1)
    world = simulate_phases(
        rig, path, len(ids), seed, rate_hz=rate_hz, n_points=rows, sigma_p=sigma_p, corruptions=pieces, ids=ids
    )
    return as_folder(world, f"simulated-{path}-{seed}")


def line(ids: Ids, seed: int, situation: str = "halts", speed: float = 0.3, rate_hz: float = 5.0) -> RecordingFolder:
    """Tags on the assembly line of known path: fixes. What the numbers mean: `trackwright simulate-line --help`."""
    world = simulate_line(situation, ids.tolist(), seed, speed=speed, rate_hz=rate_hz)
    return simulated_line(world, f"simulated-line-{situation}-{seed}")


def ranges(
    ids: Ids,
    seed: int,
    rows: int = 200,
    rate_hz: float = 10.0,
    sigma_r: float = 0.05,
    bias: float = 0.05,
    hidden: float = 0.1,
    lost: float = 0.1,
) -> RecordingFolder:
    """Hand-held UWB tags in a room with four anchors: ranges. See `trackwright simulate-ranges --help`."""
    pieces: dict[str, Corruption] = {}
    if bias > 0:
        pieces["biases"] = ranging.antenna_biases(bias)
    if hidden > 0:
        pieces["hidden"] = ranging.obstruction(hidden, 2.0, 0.3, 0.3)
    if sigma_r > 0:
        pieces["white"] = corruptions.white_noise(sigma_r)
    if lost > 0:
        pieces["lost"] = corruptions.drop_outs(lost)
    world = ranging.simulate_ranges(
        ranging.chamber(), n=len(ids), seed=seed, rate_hz=rate_hz, n_points=rows, corruptions=pieces, ids=ids
    )
    return simulated_ranging(world, f"simulated-ranges-{seed}")


def tool(
    ids: Ids, seed: int, rows: int = 800, rate_hz: float = 40.0, gap: Sequence[float] | None = None
) -> RecordingFolder:
    """Hand tools with a UWB tag and an IMU: ranges and IMU. See `trackwright simulate-imu --help`."""
    silent = None if gap is None else (gap[0], gap[1])
    world = imu.simulate_uwb_imu(
        ranging.chamber(), n=len(ids), seed=seed, rate_hz=rate_hz, n_points=rows, gap_s=silent, ids=ids
    )
    return simulated_uwb_imu(world, f"simulated-imu-{seed}")


def agv(
    ids: Ids,
    seed: int,
    rows: int = 2000,
    speed: float = 0.5,
    wild: float = 0.0,
    latency: float = 0.0,
    mirror: float = 0.0,
) -> RecordingFolder:
    """Vehicles round a workstation: fixes that drift. See `trackwright simulate-agv --help`."""
    # What depends on where the tag was comes before what adds noise.
    pieces: dict[str, Corruption] = {}
    if latency > 0:
        pieces["late"] = late(latency)
    if mirror > 0:
        pieces["mirrored"] = mirrored(vehicles.ANCHOR_HEIGHT, mirror, 3.0)
    pieces |= vehicles.FIX_ERRORS
    if wild > 0:
        pieces["wild"] = corruptions.outliers(wild, 2.0)
    world = vehicles.simulate_agv(ids.tolist(), seed, speed=speed, rows=rows, errors=pieces)
    return simulated_agv(world, f"simulated-agv-{seed}")


def _index(names: list[str], name: str, number: str) -> int:
    if name not in names:
        raise ValueError(f"{number} {name}: unknown station, expected one of {', '.join(names)}")
    return names.index(name)


WORLDS: Mapping[str, Callable[..., RecordingFolder]] = MappingProxyType(
    {"station": station, "line": line, "ranges": ranges, "tool": tool, "agv": agv}
)
"""Worlds by the name that a study in TOML calls them by."""
