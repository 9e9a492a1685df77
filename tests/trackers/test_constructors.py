"""Constructors of public trackers refuse an argument of another kind in one line, before anything is built."""

from __future__ import annotations

import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.core.run.tracker import AbstractTracker

RIG = tw.sim.work_station()
STATION = RIG.stations["1"]
BARE = tw.Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
WRONG = {
    "a rig": RIG,
    "a rig with one station": tw.Rig("hall", stations={"1": STATION}),
    "a station that gives angles": BARE,
    "such stations by name": {"1": BARE},
    "nothing by name": {},
    "nothing": None,
    "a name": "1",
    "a number that is not whole": 2.5,
    "a negative number": -1,
    "anchors": np.zeros((4, 3)),
    "a list of stations": [STATION],
}
CONSTRUCTORS = {
    "fix_tracker": tw.baselines.fix_tracker,
    "singer_tracker": tw.baselines.singer_tracker,
    "switching_tracker": tw.baselines.switching_tracker,
    "mirror_tracker": tw.baselines.mirror_tracker,
    "mhk_tracker": tw.mhk.mhk_tracker,
    "MovingWindow": lambda wrong: tw.baselines.MovingWindow(wrong, median=True),
    "range_tracker": tw.uwb_imu.range_tracker,
    "inertial_tracker": tw.uwb_imu.inertial_tracker,
    "multilateration_tracker": tw.uwb_imu.multilateration_tracker,
    "trilateration_tracker": tw.uwb_imu.trilateration_tracker,
    "line_tracker": lambda wrong: tw.line.line_tracker(wrong, {}),
    "line_grid_tracker": lambda wrong: tw.line.line_grid_tracker(wrong, {}),
    "bearing_tracker": tw.aoa.bearing_tracker,
    "beam_tracker": tw.aoa.beam_tracker,
    "beam_tracker, named": lambda wrong: tw.aoa.beam_tracker(wrong, "1"),
    "in_plane_beam_tracker": tw.aoa.in_plane_beam_tracker,
    "cascade_tracker": tw.aoa.cascade_tracker,
    "direct_tracker": tw.aoa.direct_tracker,
    "DelayAndSum.of": tw.aoa.DelayAndSum.of,
    "Smoothed": tw.Smoothed,
}
LEVELS = ("fix_tracker", "singer_tracker", "mirror_tracker")
"""Constructors whose first argument is a noise level, which may be any positive number."""


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")
@pytest.mark.parametrize("name", CONSTRUCTORS)
def test_an_argument_of_another_kind_is_refused_in_one_line(name):
    for what, wrong in WRONG.items():
        if name in LEVELS and what == "a number that is not whole":
            assert isinstance(CONSTRUCTORS[name](wrong), AbstractTracker)
            continue
        with pytest.raises(ValueError, match=r"found (\w|[-'{\[(])") as refused:
            CONSTRUCTORS[name](wrong)
        assert "\n" not in str(refused.value), what


def test_every_public_constructor_of_a_tracker_is_tried():
    # `Cascade` is made of trackers by `cascade_tracker`.
    systems = (tw.aoa, tw.baselines, tw.line, tw.mhk, tw.uwb_imu)
    public = {name for system in systems for name in system.__all__ if name.endswith(("_tracker", "Window"))}
    assert len(public) > 15
    assert public <= {name.partition(",")[0] for name in CONSTRUCTORS}


@pytest.mark.parametrize("make", [tw.aoa.beam_tracker, tw.aoa.in_plane_beam_tracker, tw.aoa.DelayAndSum.of])
def test_a_tracker_of_one_station_reads_its_phases_under_the_name_phases(make):
    times = 0.1 * np.arange(5)
    recording = tw.aoa.phase_recording(times, {"phases": np.zeros((5, 8))})
    assert make(STATION).run(recording).status.shape == (5,)
