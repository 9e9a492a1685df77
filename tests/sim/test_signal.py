"""Signals sampled by an FMCW receiver carry the phases of the phase level: same sign, mean and spread."""

import numpy as np
import pytest

from trackwright.sim.keys import trajectory_keys
from trackwright.sim.paths import hand_motion
from trackwright.sim.phases import Radar, Reflector, signal_phases, spherical_phases, wrapped
from trackwright.sim.stations import work_station

STATIONS = list(work_station().stations.values())
KEYS = trajectory_keys(0, np.arange(60))
POSITIONS = hand_motion(KEYS, np.arange(5) * 2.0)
CLEAN = spherical_phases(STATIONS, POSITIONS)
QUIET = Radar(snr=np.inf)

# A real tone's mirror at minus its frequency leaks into the peak: at 49 to 124 of 512 bins at most
# 1 / (512 sin(98 pi / 512)) of the tone, which itself is at least 2 / pi of its height there.
IMAGE_LEAKAGE = 1 / (512 * np.sin(98 * np.pi / 512)) / (2 / np.pi)


@pytest.fixture(scope="module")
def noisy():
    return signal_phases(KEYS, STATIONS, POSITIONS, Radar(snr=0.5))


def _deviations(phases, reference=CLEAN):
    """Phases less the reference, each row's common offset removed: the circular mean, then the mean."""
    residual = phases - reference
    residual = wrapped(residual - np.angle(np.exp(1j * residual).mean(axis=-1, keepdims=True)))
    return residual - residual.mean(axis=-1, keepdims=True)


def test_the_angles_that_a_beam_former_finds_in_the_signals_are_the_true_ones(noisy):
    grid = np.deg2rad(np.arange(-33, 33.1, 0.6))
    azimuths, elevations = np.meshgrid(grid, grid, indexing="ij")
    u = np.stack([np.sin(azimuths) * np.cos(elevations), np.sin(elevations)], axis=-1).reshape(-1, 2)
    for k, station in enumerate(STATIONS):
        steering = np.exp(-2j * np.pi / station.wavelength * u @ station.antennas.T)
        power = np.abs(np.exp(1j * noisy[:, 0, k]) @ steering.T)
        best = power.argmax(axis=1)
        found = np.stack([azimuths.ravel()[best], elevations.ravel()[best]], axis=-1)
        error = np.rad2deg(found - station.angles(POSITIONS[:, 0]))
        # Grid 0.3, the wave's bend about 0.5, noise of 0.07 rad 0.2 and 0.3 degrees: together below 2 degrees. With the
        # other sign both angles come out mirrored, by tens of degrees.
        assert np.abs(error).max() < 2.0
        assert np.abs(station.angles(POSITIONS[:, 0])).max() > 0.2


def test_signal_level_and_phase_level_agree_in_the_mean_of_every_antenna_and_of_both_angles(noisy):
    deviations = _deviations(noisy)
    n = deviations[..., 0].size
    sigma = Radar(snr=0.5).sigma_p
    assert np.abs(deviations.mean(axis=(0, 1, 2))).max() < 4 * sigma / np.sqrt(n)
    for station, residual in zip(STATIONS, np.moveaxis(deviations, 2, 0), strict=True):
        # Small angles about boresight: least squares of the deviations on the centred antenna places.
        places = 2 * np.pi / station.wavelength * (station.antennas - station.antennas.mean(axis=0))
        angles = residual.reshape(-1, 8) @ np.linalg.pinv(places).T
        spread = sigma * np.sqrt(np.diag(np.linalg.inv(places.T @ places)))
        assert np.all(np.abs(angles.mean(axis=0)) < 4 * spread / np.sqrt(len(angles)))


@pytest.mark.parametrize("snr", [0.5, 5.0])
def test_signal_level_and_phase_level_agree_in_spread(snr, noisy):
    radar = Radar(snr=snr)
    phases = noisy if snr == 0.5 else signal_phases(KEYS, STATIONS, POSITIONS, radar)
    deviations = _deviations(phases)
    variance = (deviations**2).sum() / (deviations.size * 7 / 8)
    # 6,300 independent deviations of 900 rows whose tone sits at its own place in the bin (a variance spread by 31 %):
    # the variance has a standard error of 2 %, the standard deviation of 1 %; three of them.
    assert np.sqrt(variance) == pytest.approx(radar.sigma_p, rel=0.03)


def test_the_peak_phase_has_no_leakage_bias_between_antennas():
    # Antennas' tones differ by up to 0.06 of a bin. Were time counted from the ramp's start, that would be 0.2 rad.
    deviations = _deviations(signal_phases(KEYS, STATIONS, POSITIONS, QUIET))
    assert np.abs(deviations).max() < 2 * IMAGE_LEAKAGE < 0.012


def test_signals_have_an_unknown_common_phase_in_every_row():
    common = np.angle(np.exp(1j * (signal_phases(KEYS, STATIONS, POSITIONS, QUIET) - CLEAN)).mean(axis=-1)).ravel()
    # 900 uniform angles: their mean vector has a length of about 1 / 30.
    assert np.abs(np.exp(1j * common).mean()) < 4 / 30


def test_a_reflector_near_the_beacon_adds_its_mirror_image_to_the_wave():
    floor = Reflector(np.array([0.0, 0.0, -0.01]), np.array([0.0, 0.0, 2.0]), gain=0.3)
    near = POSITIONS * [1, 1, 0.1]
    phases = signal_phases(KEYS, STATIONS, near, QUIET, reflectors=[floor])
    direct = np.exp(1j * spherical_phases(STATIONS, near))
    image = np.exp(1j * spherical_phases(STATIONS, near * [1, 1, -1] - [0, 0, 0.02]))
    bent = np.angle(direct + 0.3 * image)
    assert np.abs(_deviations(bent, spherical_phases(STATIONS, near))).max() > 0.05
    # An extra path of up to 0.08 m moves the copy's tone by 0.07 bins and changes its height by a sixth at most, of an
    # echo of 0.3 in a sum of at least 0.7.
    np.testing.assert_allclose(_deviations(phases, bent), 0, atol=0.3 / 6 / 0.7 + 2 * IMAGE_LEAKAGE)


def test_the_low_pass_suppresses_a_strong_distant_echo():
    # Mirrored at 75 m: 150 m or 122 kHz further, three times as loud.
    far = Reflector(np.array([0.0, 75.0, 0.0]), np.array([0.0, 1.0, 0.0]), gain=3.0)
    radars = {cutoff: Radar(snr=np.inf, cutoff_hz=cutoff, sync_s=(0.2e-6, 0.25e-6)) for cutoff in (80e3, 1e9)}
    taken = {
        cutoff: np.abs(_deviations(signal_phases(KEYS, STATIONS, POSITIONS, radar, reflectors=[far]))).max()
        for cutoff, radar in radars.items()
    }
    # What is left of the echo leaks a few hundredths of its height into the peak, 125 bins away.
    assert taken[80e3] < 0.05
    assert taken[1e9] > 1.0
