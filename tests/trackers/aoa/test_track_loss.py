"""The beam tracker from its own start: acquisition, track loss and restart.

In single precision, as users run it.
"""

import numpy as np
import pytest

from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beam import beam_tracker
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Readings, Recording, stack

ROWS, ANTENNAS, SIGMA_P, JUMP_ROW = 120, 8, 0.15, 50
STATION = work_station().stations["1"]
TIMES = np.arange(ROWS) * 0.1
JUMP, SILENT, LATE = range(3)


def _angles(trajectory):
    """True azimuth and elevation (ROWS, 2): a slow oval, other for each trajectory, with a jump by 25° for one."""
    phase = 0.4 * TIMES + trajectory
    angles = np.stack([0.25 * np.cos(phase), 0.2 * np.sin(phase)], axis=1)
    if trajectory == JUMP:
        angles[JUMP_ROW:, 0] -= np.sign(angles[JUMP_ROW, 0]) * np.deg2rad(25)
    return angles


def _recording(trajectory, rng):
    azimuth, elevation = (a[:, None] for a in _angles(trajectory).T)
    x, y = STATION.antennas.T
    phases = 2 * np.pi / STATION.wavelength * (x * np.sin(azimuth) * np.cos(elevation) + y * np.sin(elevation))
    phases += rng.uniform(-np.pi, np.pi, (ROWS, 1)) + SIGMA_P * rng.normal(size=phases.shape)
    seen = rng.random(phases.shape) < 0.9
    if trajectory == SILENT:
        seen[30:90] = False
    if trajectory == LATE:
        # Two antennas are no direction: the start waits for a third.
        seen[:20] = np.arange(ANTENNAS) < 2
    return Recording(TIMES, {"1": Readings(np.angle(np.exp(1j * phases)), seen)}, name=str(trajectory))


@pytest.fixture(scope="module")
def estimates():
    recordings = [_recording(trajectory, np.random.default_rng(trajectory)) for trajectory in range(3)]
    return beam_tracker(STATION, "1", sigma_p=2 * SIGMA_P).run(stack(recordings, dtype=np.float32))


def _error(estimates, trajectory):
    """Degrees, by row, the larger of both angles."""
    mean = estimates[trajectory].mean
    return np.rad2deg(np.abs(np.stack([mean.azimuth, mean.elevation], axis=1) - _angles(trajectory)).max(axis=1))


def test_after_a_jump_the_track_is_lost_restarted_and_recovers(estimates):
    status = estimates[JUMP].status
    restarts = np.flatnonzero(status == Status.RESTARTED)
    assert np.all(status[:JUMP_ROW] == Status.OK)
    # Two or three rows of a running mean over eight are enough to pass the limit of six.
    assert JUMP_ROW <= restarts[0] <= JUMP_ROW + 4
    assert _error(estimates, JUMP)[restarts[-1] + 5 :].max() < 2
    assert estimates[JUMP].summary().startswith("lost and re-started")


def test_a_long_gap_is_a_track_loss_and_the_next_measurement_restarts_it(estimates):
    status = estimates[SILENT].status
    # Five seconds of patience are fifty rows of the sixty.
    assert np.all(status[30:80] == Status.OK)
    assert np.all(status[81:90] == Status.LOST)
    assert status[90] == Status.RESTARTED
    assert _error(estimates, SILENT)[95:].max() < 2


def test_a_track_waits_for_three_antennas(estimates):
    status = estimates[LATE].status
    assert np.all(status[:20] == Status.WAITING)
    assert np.all(status[20:] == Status.OK)
    assert _error(estimates, LATE)[25:].max() < 2
