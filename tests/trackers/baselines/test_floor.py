"""A floor with walls, from rig.toml to the tracks: what is read, what is refused, and what the walls are good for."""

import numpy as np
import polars as pl
import pytest

from tests.in_process import PLAIN, trackwright
from trackwright.trackers.baselines.floor import Walls
from trackwright.trackers.core.filters.particle.resampling import LOG_ZERO
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import Placed
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, write_recording

OUTLINE = np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 8.0], [10.5, 8.0], [10.5, 1.5], [0.0, 1.5]])
"""A corridor 1.5 m wide that turns left, m."""

SPARE = np.array([[11.5, 9.0, 12.0, 9.0]])  # a wall that nobody meets


def _folder():
    """A tag that walks along the middle of the corridor; its errors last for seconds and reach through the walls."""
    rng = np.random.default_rng(1)
    times = np.arange(160) * 0.25
    along = np.interp(times, [0, 40], [0.8, 17.0])
    truth = np.stack([np.minimum(along, 11.25), 0.75 + np.maximum(along - 11.25, 0.0)], axis=1)
    slow = np.zeros((160, 2))
    for k in range(1, 160):
        slow[k] = 0.9 * slow[k - 1] + 0.45 * rng.standard_normal(2)
    fixes = truth + slow + 0.2 * rng.standard_normal((160, 2))

    def table(places):
        return pl.DataFrame({"t_s": times, "tag": "1", "x_m": places[:, 0], "y_m": places[:, 1], "z_m": 1.0})

    rig = Rig("corner", outline=OUTLINE, walls=SPARE)
    return RecordingFolder("corner", None, rig, {"fixes": table(fixes), "truth": table(truth)})


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    path = tmp_path_factory.mktemp("floor")
    write_recording(_folder(), path / "corner")
    return path


@pytest.fixture(scope="module")
def tracked(there):
    said = trackwright("track", there / "corner", *PLAIN, "--out", there / "picked")
    assert said.code == 0, said.err
    assert said.err.startswith("tracker: floor-pf (")
    return pl.read_parquet(there / "picked" / "tracks.parquet")


def test_walls_and_outline_are_written_and_read_back(there):
    rig = read_recording(there / "corner").rig
    np.testing.assert_array_equal(rig.walls, SPARE)
    np.testing.assert_array_equal(rig.outline, OUTLINE)
    np.testing.assert_array_equal(rig.all_walls()[:2], [SPARE[0], [0.0, 0.0, 12.0, 0.0]])


@pytest.mark.slow
def test_a_folder_with_a_floor_plan_is_tracked_between_its_walls(tracked):
    assert (tracked["status"] == "ok").mean() > 0.95
    inside = Walls(outline=OUTLINE)
    places = tracked.filter(pl.col("status") == "ok").select("x_m", "y_m").to_numpy()
    # A mean of places on both sides of a corner may itself be beyond it.
    assert np.mean([_outside(inside, place) for place in places]) < 0.02


def _outside(walls, place):
    x, y = np.asarray(place)
    odd = sum(
        ((a[1] > y) != (b[1] > y)) and x < (b[0] - a[0]) * (y - a[1]) / (b[1] - a[1]) + a[0]
        for a, b in zip(walls.outline, np.roll(walls.outline, -1, axis=0), strict=True)
    )
    return odd % 2 == 0


def test_the_walls_take_a_quarter_of_the_error_across_the_corridor(there, tracked):
    assert trackwright("track", there / "corner", "--tracker", "fix-kf", *PLAIN, "--out", there / "free").code == 0
    errors = []
    for table in (tracked, pl.read_parquet(there / "free" / "tracks.parquet")):
        both = table.join(_folder().tables["truth"], on="t_s", suffix="_true").filter(pl.col("x_m_true") < 10.0)
        errors.append(float(np.sqrt(np.nanmean((both["y_m"] - both["y_m_true"]).to_numpy() ** 2))))
    assert errors[0] < 0.75 * errors[1]


def test_what_begins_outside_the_outline_dies_at_its_first_move():
    walls = Walls(outline=OUTLINE)
    outside, inside = Placed(Vector(*np.array([-1.0, 0.7]))), Placed(Vector(*np.array([1.0, 0.7])))
    assert walls.log_weight(outside, outside) == LOG_ZERO
    assert walls.log_weight(inside, inside) == 0
    # Across the inner corner: both ends are inside, the way is not.
    assert walls.log_weight(Placed(Vector(*np.array([9.0, 1.0]))), Placed(Vector(*np.array([11.0, 6.0])))) == LOG_ZERO
