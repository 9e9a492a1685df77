"""Events of tags that leave a path to which their tracker constrains them, from ranges and from fixes."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.evaluation.events import events_of, off_the_path
from trackwright.trackers.recordings.folder import RecordingFolder

ANCHORS = {
    "1": (0.0, -5.0, 2.5),
    "2": (20.0, -5.0, 2.5),
    "3": (0.0, 9.0, 2.0),
    "4": (20.0, 9.0, 1.0),
    "5": (9.0, 2.0, 3.0),
}
KNOTS = np.array([[0.0, 0.0], [20.0, 0.0]])


def _leaving(measurements):
    """A tag that walks along y = 0, leaves it by 5 m from 8 to 16 s, and comes back."""
    times = np.arange(0, 24, 0.1)
    aside = 5 * np.clip(np.minimum(times - 8, 16 - times), 0, 1)
    place = np.stack([0.8 * times, aside, np.ones(len(times))], axis=1)
    ids = {"t_s": times, "tag": ["T"] * len(times)}
    fixes = pl.DataFrame(ids | {f"{a}_m": place[:, k] for k, a in enumerate("xyz")})
    ranges = [
        pl.DataFrame(ids | {"anchor": [name] * len(times), "range_m": np.linalg.norm(place - at, axis=1)})
        for name, at in ANCHORS.items()
    ]
    tables = {"fixes": fixes, "ranges": pl.concat(ranges).sort("t_s", maintain_order=True)}
    anchors = {name: np.array(at) for name, at in ANCHORS.items()}
    rig = Rig("hall", anchors=anchors, tags={"T": Tag(height=1.0)}, path_knots=KNOTS)
    return RecordingFolder("hall", None, rig, {measurements: tables[measurements]})


@pytest.mark.parametrize("measurements", ["ranges", "fixes"])
def test_a_tag_that_leaves_its_line_has_an_event_and_one_when_it_returns(measurements):
    folder = _leaving(measurements)
    spec, batches = spec_of("line-grid"), tw.build("line-grid", folder).batches(folder)
    on_line = pl.DataFrame(
        {
            "recording": "hall",
            "tag": "T",
            "t_s": 0.1 * np.arange(240),
            "x_m": 0.08 * np.arange(240),
            "y_m": 0.0,
            "status": "ok",
        }
    )
    events = events_of(on_line, spec, batches)
    left, back = events.rows(named=True)
    assert (left["event"], back["event"]) == ("left the line", "back on the line")
    assert 8 < left["t_s"] < 10
    # excursions end once the sum of what exceeds the slack is used up
    assert 15 < back["t_s"] < 23


def test_a_tag_beside_its_prescribed_path_is_told_with_the_distance_and_the_way_back(beginnings):
    folder = tw.read(beginnings / "good")
    trajectory = next(iter(spec_of("bearings").trajectories(folder, False)))
    times = np.arange(0.0, 12.0, 0.1)
    # The path runs along y = 1 m from x = 1 to 5 m; from 4 to 8 s the tag is 0.9 m beside it.
    beside = np.where((times >= 4) & (times < 8), 0.9, 0.0)
    tracks = pl.DataFrame({"t_s": times, "x_m": 1 + times / 3, "y_m": 1 - beside, "std_x_m": 0.05, "std_y_m": 0.05})
    (left, off, far), (back, on, _) = off_the_path(trajectory, tracks)
    assert (off, on) == ("off the prescribed path", "back on the path")
    assert left == pytest.approx(4.0, abs=0.11)
    assert 8.0 < back < 11.0
    assert far == "up to 0.90 m from it"
