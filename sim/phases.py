"""Ideal phases at an antenna array: of spherical waves, and in the plane-wave approximation of the trackers.

The sign is that of equation (9) of paper A and of the recordings: phase of antenna i = +2 pi / lambda * p_i . u +
common, u the unit vector to the beacon. The common offset of a station's row holds no information and is omitted here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64

from trackwright.trackers.core.model.rig import Station


def wrapped(angle: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """The angles wrapped into (-pi, pi], rad, float64."""
    turn = 2 * np.pi
    angle = np.asarray(angle, float)
    return angle - turn * np.ceil(angle / turn - 0.5)


def spherical_phases(
    stations: Sequence[Station], positions: Float[np.ndarray, "*rows 3"]
) -> Float[np.ndarray, "*rows stations antennas"]:
    """Phases (..., stations, antennas), rad in (-pi, pi], of spherical waves from beacons at positions (..., 3), m.

    The phase of antenna i is -2 pi / lambda times its distance from the beacon. Raises ValueError for stations without
    an array or with arrays of unequal size.
    """
    antennas, wavelengths = antenna_arrays(stations)
    x, y, z = np.moveaxis(np.asarray(positions, float)[..., None, None, :], -1, 0)
    distances = np.sqrt((x - antennas[..., 0]) ** 2 + (y - antennas[..., 1]) ** 2 + (z - antennas[..., 2]) ** 2)
    return wrapped(distances * (-2 * np.pi / wavelengths[:, None]))


def plane_phases(
    stations: Sequence[Station], positions: Float[np.ndarray, "*rows 3"]
) -> Float[np.ndarray, "*rows stations antennas"]:
    """Phases (..., stations, antennas) of plane waves, equation (9): 2 pi / lambda * p_i . u.

    An approximation for distant beacons; for worlds in which a tracker's model is exact. Shapes, units and errors as in
    `spherical_phases`.
    """
    antenna_arrays(stations)
    columns = []
    for station in stations:
        x, y, z = np.moveaxis(station.position_in_array(positions), -1, 0)
        wave_number = 2 * np.pi / (station.wavelength * np.sqrt(x**2 + y**2 + z**2))
        flat = np.asarray(station.antennas)
        columns.append((wave_number * x)[..., None] * flat[:, 0] + (wave_number * y)[..., None] * flat[:, 1])
    return wrapped(np.stack(columns, axis=-2))


def antenna_arrays(
    stations: Sequence[Station],
) -> tuple[Float[np.ndarray, "stations antennas 3"], Float[np.ndarray, " stations"]]:
    """Antenna positions (stations, antennas, 3), m, world frame, and wavelengths (stations,), m.

    Raises ValueError for no station, for stations without an array or wavelength, and for arrays of unequal size.
    """
    if any(station.antennas is None or station.wavelength is None for station in stations):
        raise ValueError("phases need stations with antennas and a wavelength, found a station without")
    sizes = [len(station.antenna_positions()) for station in stations]
    if len(set(sizes)) != 1:
        raise ValueError(f"phases need one or more stations with equal numbers of antennas, found {sizes}")
    antennas = np.stack([station.antenna_positions() for station in stations])
    return antennas, np.array([station.wavelength for station in stations], float)
