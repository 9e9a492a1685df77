"""Phases at an antenna array: of spherical waves, in the plane-wave approximation of the trackers, and of signals.

The sign is as in equation (9) of paper A and of the recordings: phase of antenna i = +2 pi / lambda * p_i . u +
common, u the unit vector to the beacon. The common offset of a station's row holds no information and is omitted from
ideal phases.

The signal level is as in paper A, equations (1)-(3), section 4: sampled FMCW baseband signals per antenna, and the
phases estimated from them. The beacon's ramp arrives after its time of flight and is mixed with the station's own,
which started at an unknown time and phase: a tone whose frequency gives the delay and whose phase gives the direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from trackwright.sim.keys import Keys, normals, stream, uniforms
from trackwright.trackers.aoa.phases import SPEED_OF_LIGHT
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


@dataclass(frozen=True)
class Radar:
    """An FMCW receiver; the wavelength at the middle of the ramp is the station's.

    `snr`: power of the direct tone over noise power in one sample of one antenna (a ratio; infinite for no noise). The
    ramp: `bandwidth_hz` in `ramp_s`, `n_samples` in that time. `cutoff_hz`: of the low-pass before sampling,
    fourth-order Butterworth (the printed 5 GHz cannot be a baseband's). `sync_s`: range of the station's unknown
    start, tau_m, uniform and independent in every row.
    """

    snr: float = 1.0
    bandwidth_hz: float = 250e6
    ramp_s: float = 1024e-6
    n_samples: int = 512
    cutoff_hz: float = 200e3
    sync_s: tuple[float, float] = (0.2e-6, 0.5e-6)

    def __post_init__(self) -> None:
        tone = self.bandwidth_hz / self.ramp_s * np.asarray(self.sync_s)
        if not (self.snr > 0 and 0 < tone[0] <= tone[1] < self.n_samples / self.ramp_s / 2):
            raise ValueError(
                f"radar tone {tone[0]:.4g}..{tone[1]:.4g} Hz at {self.n_samples / self.ramp_s:.4g} samples/s, snr "
                f"{self.snr}: expected a tone between 0 and half the sampling rate and a positive snr"
            )

    @property
    def sigma_p(self) -> float:
        """Standard deviation, rad, of the phase at the FFT's peak of N samples of a real tone in white noise.

        Amplitude A and noise sigma make a sample's snr A² / (2 sigma²). The peak is N A / 2 times sinc(d) with the tone
        d bins from the bin's middle; noise there has the standard deviation sigma sqrt(N / 2) across it. The quotient
        is 1 / (sqrt(N snr) sinc(d)). Coarse synchronisation makes d uniform on +-1/2, and the mean of 1 / sinc² is
        2 ln 2. A small-angle approximation: valid well below 1 rad.
        """
        return float(np.sqrt(2 * np.log(2) / (self.n_samples * self.snr)))


@dataclass(frozen=True)
class Reflector:
    """A large plane reflector that adds a delayed copy of the beacon's signal, as if from its mirror image.

    `point` on the plane (3,), m; `normal` (3,); `gain`: amplitude ratio of the copy to the direct wave. The error of
    phase differences comes from the direction of the image: a copy with equal extra path at all antennas causes none.
    """

    point: Float[np.ndarray, " 3"]
    normal: Float[np.ndarray, " 3"]
    gain: float

    def image(self, positions: Float[np.ndarray, "*rows 3"]) -> Float[np.ndarray, "*rows 3"]:
        """The mirror images (..., 3), m, of positions (..., 3), m."""
        normal = np.asarray(self.normal, float) / np.linalg.norm(self.normal)
        height = ((positions - self.point) * normal).sum(axis=-1, keepdims=True)
        return positions - 2 * height * normal


def signal_phases(
    keys: Keys,
    stations: Sequence[Station],
    positions: Float[np.ndarray, "n T 3"],
    radar: Radar,
    *,
    reflectors: Sequence[Reflector] = (),
) -> Float[np.ndarray, "n T n_stations antennas"]:
    """Phases (n, T, stations, antennas), rad in (-pi, pi], from sampled signals of beacons at positions (n, T, 3), m.

    Holds all n × T × stations × antennas signals in memory. Raises ValueError for stations as `spherical_phases`.
    """
    antennas, wavelengths = antenna_arrays(stations)
    positions = np.asarray(positions, float)
    rows = (*positions.shape[:2], len(stations))
    antennas_at_rows = np.broadcast_to(antennas, rows[:2] + antennas.shape)
    earliest, latest = radar.sync_s
    sync = earliest + (latest - earliest) * uniforms(stream(keys, "sync"), rows[1:]).astype(float)
    common = 2 * np.pi * uniforms(stream(keys, "common phase"), rows[1:]).astype(float)[..., None]

    # Time and carrier phase are counted from the middle of the ramp. The spectrum of a window centred at zero is real,
    # so that the phase at the peak is the carrier's, whatever the bin. Counted from the start of the ramp, the
    # phase would change by half a turn per bin, and antennas, whose tones differ by hundredths of a bin, would be
    # biased.
    t = (np.arange(radar.n_samples) - (radar.n_samples - 1) / 2) * (radar.ramp_s / radar.n_samples)
    chirp = radar.bandwidth_hz / radar.ramp_s
    carrier = 2 * np.pi * SPEED_OF_LIGHT / wavelengths[:, None]

    baseband = np.zeros(antennas_at_rows.shape[:-1] + t.shape)
    for beacon, gain in [(positions, 1.0), *((r.image(positions), r.gain) for r in reflectors)]:
        flight = np.sqrt(((beacon[:, :, None, None] - antennas_at_rows) ** 2).sum(axis=-1)) / SPEED_OF_LIGHT
        delay = sync[..., None] + flight
        tone = chirp * delay
        # The low-pass acts before sampling. Its phase shift is common to all antennas: only its gain matters.
        passed = gain / np.sqrt(1 + (tone / radar.cutoff_hz) ** 8)
        baseband += passed[..., None] * np.cos(
            (2 * np.pi * tone)[..., None] * t + (carrier * delay + common)[..., None]
        )
    if np.isfinite(radar.snr):
        baseband += normals(stream(keys, "noise"), baseband.shape[1:]) / np.sqrt(2 * radar.snr)
    return wrapped(-_peak_phase(baseband))


def _peak_phase(baseband: Float[np.ndarray, "*rows antennas N"]) -> Float[np.ndarray, "*rows antennas"]:
    """Phase (..., antennas) in the bin with the largest sum of magnitude spectra of samples (..., antennas, N).

    By equation (2) it grows with distance; by equation (9) and in the recordings it falls: callers take the conjugate.
    """
    # The FFT counts time from the first sample: in one bin, a rotation common to all antennas, without effect.
    spectrum = np.fft.rfft(baseband)
    peak = np.abs(spectrum).sum(axis=-2).argmax(axis=-1)[..., None, None]
    return np.angle(np.take_along_axis(spectrum, peak, axis=-1)[..., 0])
