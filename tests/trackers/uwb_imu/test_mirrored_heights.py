"""Heights at the plane of the anchors: on which side tracks start and stay, and what is told."""

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import with_truth
from trackwright.trackers.recordings.folder import RecordingFolder

SECONDS, SIZE = 15.0, np.array([12.0, 8.0])
FLOOR = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0], [0.5, 1]])


def _site(seed, plane, height):
    """A recording with ranges to six anchors within 0.3 m of a plane, each with a bias, to a tag at `height(t)`."""
    random = np.random.default_rng(seed)
    anchors = np.column_stack([FLOOR * SIZE, plane + random.uniform(-0.15, 0.15, 6)])
    t = np.arange(0.0, SECONDS, 0.1)
    turn = 0.3 * t + random.uniform(0.0, 6.0)
    place = np.column_stack([6.0 + 3.0 * np.cos(turn), 4.0 + 2.0 * np.sin(turn), height(t)])
    ranges = np.linalg.norm(place[:, None] - anchors, axis=2) + random.normal(0.04, 0.05, 6)
    ranges += random.normal(0.0, 0.06, ranges.shape)
    rows = {
        "t_s": np.repeat(t, 6),
        "tag": ["T"] * 6 * len(t),
        "anchor": [*"abcdef"] * len(t),
        "range_m": ranges.ravel(),
    }
    truth = {"t_s": t, "tag": ["T"] * len(t)} | dict(zip(("x_m", "y_m", "z_m"), place.T, strict=True))
    rig = Rig(f"site {seed}", dict(zip("abcdef", anchors, strict=True)))
    return RecordingFolder(f"r{seed}", None, rig, {"ranges": pl.DataFrame(rows), "truth": pl.DataFrame(truth)})


HALLS = [_site(k, 3.0, lambda t: 1.1 + 0.0 * t) for k in range(5)]
DRONES = [_site(k, 0.15, lambda t: 0.2 + 1.8 * np.clip((t - 2.0) / 4.0, 0.0, 1.0)) for k in range(5)]
MIDDLE = [_site(k, 1.3, lambda t: 2.3 + 0.0 * t) for k in range(5)]


def _wrong_side(tracks, folders):
    """The recordings of which a tenth of the estimates, or more, is on the other side than the truth."""
    rows, wrong = with_truth(tracks.table, folders).filter(pl.col("why").is_null()), []
    for folder in folders:
        below = [pl.col(name) < folder.rig.plane for name in ("z_m", "true_z_m")]
        own = rows.filter(pl.col("recording") == folder.name, (pl.col("true_z_m") - folder.rig.plane).abs() > 0.5)
        if own.select((below[0] != below[1]).mean()).item() > 0.1:
            wrong.append(folder.name)
    return wrong


@pytest.mark.slow
@pytest.mark.parametrize("folders", [HALLS, DRONES], ids=["halls", "drones"])
@pytest.mark.parametrize("name", ["uwb", "multilateration"])
def test_tracks_are_on_the_likely_side_of_anchors_at_the_ceiling_and_on_the_floor(name, folders):
    tracks = tw.build(name, folders).run(folders)
    assert _wrong_side(tracks, folders) == []
    assert [line.partition(":")[0] for line in tracks.notices] == [folder.rig.name for folder in folders]


@pytest.mark.slow
def test_a_given_side_decides_where_neither_is_likelier_and_truth_tells_the_wrong_one():
    above, below = (tw.build("uwb", MIDDLE, side=side).run(MIDDLE) for side in ("above", "below"))
    assert (_wrong_side(above, MIDDLE), above.notices) == ([], ())
    assert _wrong_side(below, MIDDLE) == [folder.name for folder in MIDDLE]


def test_arrays_take_the_side_too():
    anchors, times = np.array([*MIDDLE[0].rig.anchors.values()]), np.arange(0.0, SECONDS, 0.1)
    ranges = MIDDLE[0].tables["ranges"]["range_m"].to_numpy().reshape(-1, 6)
    for side, sign in (("above", 1.0), ("below", -1.0)):
        recording = tw.uwb_imu.range_recording(times, ranges, anchors, side=side)
        heights = np.asarray(tw.uwb_imu.range_tracker(6).run(recording).mean.position[2])
        assert sign * (heights[-1] - 1.3) > 0.0


def test_another_side_is_refused():
    with pytest.raises(UnusableInput, match="side 'up': expected 'above' or 'below'"):
        tw.build("uwb", HALLS[0], side="up")


def test_anchors_at_two_levels_have_no_plane():
    levels = {str(k): np.array([*place, 2.5 * (k % 2)]) for k, place in enumerate(FLOOR * SIZE)}
    assert Rig("two levels", levels).plane is None
