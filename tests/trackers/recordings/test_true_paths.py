"""Truth of many tags at once, against NumPy's interpolation of each path by itself; times of counters that wrap."""

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.data import HOLE_M, HOLE_S
from trackwright.trackers.core.errors import UNIX_S
from trackwright.trackers.recordings.columns import QUATERNION, TagRows, TruePaths, TruthStatus
from trackwright.trackers.recordings.tables import WRAPS, restarted_at, unwrapped


def _alone(at, times, positions):
    """Positions and status of one path by np.interp."""
    status = np.full(len(at), TruthStatus.SCORED)
    found = np.stack([np.interp(at, times, axis) for axis in positions.T], axis=1)
    if len(times) > 1:
        moved = np.sqrt(np.nansum(np.diff(positions, axis=0) ** 2, axis=1))
        hole = (np.diff(times) > HOLE_S) & (moved > HOLE_M)
        after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        status[hole[after - 1] & (times[after - 1] < at) & (at < times[after])] = TruthStatus.HOLE
    status[(at < times[0]) | (at > times[-1])] = TruthStatus.NO_TRUTH
    found[status != TruthStatus.SCORED] = np.nan
    return found, status


def _rows(tags, times, positions, **attitudes):
    axes = dict(zip(("x_m", "y_m", "z_m"), positions.T, strict=True))
    return TagRows(pl.DataFrame({"tag": tags, "t_s": times} | axes | attitudes))


def _path(rng):
    times = np.unique(np.round(rng.uniform(0, 20, rng.integers(1, 30)), 2))
    positions = rng.normal(size=(len(times), 3)) * rng.choice([0.001, 1.0])
    positions[rng.uniform(size=len(times)) < 0.2, 2] = np.nan
    return times, positions


@pytest.mark.parametrize("same", [False, True], ids=["paths of their own times", "paths of the same times"])
def test_truth_of_many_tags_is_that_of_each_to_the_bit(same):
    rng = np.random.default_rng(7)
    for _ in range(40):
        paths = [_path(rng) for _ in range(4)]
        if same:
            paths = [(paths[0][0], rng.normal(size=paths[0][1].shape)) for _ in paths]
        wanted = [np.sort(np.append(rng.uniform(-1, 21, rng.integers(0, 40)), rng.choice(t, 3))) for t, _ in paths]
        tags, starts = [str(k) for k in range(4)], np.cumsum([0, *(len(t) for t, _ in paths)])
        together = TruePaths(_rows(np.repeat(tags, np.diff(starts)), *map(np.concatenate, zip(*paths, strict=True))))
        found = together.at(tags, np.cumsum([0, *map(len, wanted)]), np.concatenate(wanted))
        alone = [_alone(at, *path) for at, path in zip(wanted, paths, strict=True)]
        for array, each in zip(found, zip(*alone, strict=True), strict=True):
            np.testing.assert_array_equal(array, np.concatenate(each))


def test_headings_are_unknown_where_the_attitudes_have_a_hole():
    times, yaw = np.arange(0.0, 10.0, 0.25), np.linspace(0.0, 9.0, 40)
    attitudes = np.stack([np.cos(yaw / 2), *np.zeros((2, 40)), np.sin(yaw / 2)], axis=1)
    attitudes[(times > 3.0) & (times < 6.0) | (times == 8.0)] = np.nan
    paths = TruePaths(_rows(["a"] * 40, times, np.zeros((40, 3)), **dict(zip(QUATERNION, attitudes.T, strict=True))))
    at = np.array([-1.0, 0.1, 3.0, 3.1, 5.9, 6.0, 8.1, 9.75, 9.8])
    found = paths.headings_at(["a"], np.array([0, len(at)]), at)
    known = np.isin(at, [0.1, 3.0, 6.0, 8.1, 9.75])
    np.testing.assert_array_equal(np.isfinite(found), known)
    turned = found[known] - np.interp(at[known], times, yaw)
    np.testing.assert_allclose(np.remainder(turned + np.pi, 2 * np.pi) - np.pi, 0.0, atol=1e-9)


@pytest.mark.parametrize("period", WRAPS)
def test_a_counter_or_clock_that_wraps_is_unwrapped_and_named(period):
    t = 0.1 * np.arange(200) + period - 7.0
    found, (notice,) = unwrapped(pl.DataFrame({"t_s": t % period}), [])
    np.testing.assert_allclose(found["t_s"], t, rtol=1e-9)
    assert WRAPS[period] in notice
    # Rows of one sensor after those of another go back by the length of the recording.
    ends, blocks = np.tile(np.linspace(0.0, period, 200), 2), np.arange(400) // 200
    for rare, sensor in ((t, 0), (period / 3 * np.arange(9), 0), (ends, blocks)):
        assert (
            unwrapped(pl.DataFrame({"t_s": rare, "sensor": np.broadcast_to(sensor, rare.shape)}), ["sensor"])[1] == []
        )


def test_a_clock_that_restarts_is_found_also_where_it_repeats_no_time_but_not_late_or_unsorted_rows():
    t = 0.1 * np.arange(200)
    restarts = {
        "at zero": np.append(t + 30.0, t[:60]), "an hour back": np.append(t + UNIX_S, t - 3580.0 + UNIX_S),
        "again": np.append(t, t),
    }  # fmt: skip
    others = (np.append(t[90:], t[:90]), t[::-1], np.append(t + UNIX_S + 900.0, t + UNIX_S), np.append(t + 30.0, t[:3]))
    assert {name: restarted_at(times) for name, times in restarts.items()} == dict.fromkeys(restarts, 200)
    assert all(restarted_at(times) is None for times in others)
    # An anchor out of reach where one half of a file ends and the other, which stands first, begins.
    sparse = np.append(t[110:], t[:50])
    assert (restarted_at(sparse), restarted_at(sparse, t)) == (90, None)
