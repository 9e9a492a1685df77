"""Time stamps in any unit are the seconds that they mean, and never the bits that count their unit."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.data.recording import Readings, Recording
from trackwright.trackers.core.errors import moment, seconds, span, time_label, zero_of
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.from_arrays import fix_recording, range_recording
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import first_time

START = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
STAMPS = [START + timedelta(milliseconds=250 * k) for k in range(5)]
TRUE = np.array([stamp.timestamp() for stamp in STAMPS])
NAIVE = np.array([stamp.replace(tzinfo=None) for stamp in STAMPS], "datetime64[us]")


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_a_recordings_times_are_seconds_whatever_the_unit(unit):
    times = NAIVE.astype(f"datetime64[{unit}]")
    readings = {"fixes": Readings(np.zeros((5, 3)), np.ones((5, 3), bool))}
    assert Recording(times, readings).times == pytest.approx(TRUE, abs=1e-6)
    assert np.diff(fix_recording(times, np.zeros((5, 3))).times) == pytest.approx(0.25, abs=1e-6)
    anchors = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0], [5, 5, 2]])
    assert np.ptp(range_recording(times, np.full((5, 4), 3.0), anchors).times) == pytest.approx(1.0, abs=1e-6)


def test_durations_time_zones_and_whole_seconds():
    assert seconds(np.array([0, 1500], "timedelta64[ms]")) == pytest.approx([0.0, 1.5])
    assert seconds(np.array(STAMPS, object)) == pytest.approx(TRUE, abs=1e-6)
    assert seconds(np.array(["1970-01-02"], "datetime64[D]")) == pytest.approx([86400.0])
    assert seconds([1, 2]).dtype == np.float64


def test_pandas_columns_and_indices():
    pd = pytest.importorskip("pandas", reason="pandas is not installed")
    for zone in (None, "UTC", "Europe/Berlin"):
        index = pd.DatetimeIndex(NAIVE).tz_localize("UTC").tz_convert(zone)
        for given in (index, pd.Series(index), index.as_unit("ms")):
            assert seconds(given) == pytest.approx(TRUE, abs=1e-6)


def test_missing_and_unclear_time_stamps_are_refused():
    with pytest.raises(ValueError, match=r"times\[1\] is missing"):
        seconds(np.array(["2026-01-01", "NaT"], "datetime64[s]"))
    with pytest.raises(ValueError, match=r"datetime64\[M\]"):
        seconds(np.array(["2026-01"], "datetime64[M]"))


def test_tables_with_time_stamps_are_in_seconds():
    table = pl.DataFrame({"t_s": STAMPS, "tag": "T", "x_m": 0.0, "y_m": 0.0, "z_m": 0.0})
    folder = RecordingFolder("stamped", None, Rig("stamped"), {"fixes": table})
    assert folder.rows("fixes").times == pytest.approx(TRUE, abs=1e-6)
    assert first_time(folder.tables) == TRUE[0]


def test_times_that_count_from_1970_are_never_rounded_to_five_digits():
    unix = 1777896826.66
    assert moment(unix) == "2026-05-04 12:13:46.66 UTC"
    assert moment(12.5) == "12.5 s"
    assert moment(1234567.25) == "1234567.25 s"
    assert moment(1777897459.9 - 1777897400.0) == "59.9 s"
    assert moment(1.77e12) == "1.77e+12 s"
    assert span(unix, unix + 1) == "2026-05-04 12:13:46.66 UTC to 2026-05-04 12:13:47.66 UTC"
    assert span(0.0, 120.1) == "0 to 120.1 s"
    assert (zero_of(1777896800.26), zero_of(12.5), zero_of(np.inf)) == (1777896800.26, 0.0, 0.0)
    assert time_label(1777896800.26) == "time (s) since 2026-05-04 12:13:20.26 UTC"
    recording = fix_recording(unix + np.arange(3.0), np.zeros((3, 3)))
    assert "e+" not in repr(recording)
