"""Bodies with several ranging tags: position and heading, and where the ranges of a tag end."""

import dataclasses

import numpy as np
import polars as pl
import pytest

import trackwright as tw
from trackwright.trackers.core.model.rig import Rig, Tag
from trackwright.trackers.recordings.folder import RecordingFolder, Selection
from trackwright.trackers.recordings.rig_file import read_rig, rig_text
from trackwright.tuning.calibrating import calibrate

pytestmark = pytest.mark.slow

CORNERS = {f"A{k}": np.array(place) for k, place in enumerate([(-3, -3, 2.2), (3, -3, 2.6), (3, 3, 2.2), (-3, 3, 2.6)])}
OFFSETS = {"front": (0.3, 0.0), "left": (-0.2, 0.25), "right": (-0.2, -0.25)}
HEIGHT, SIGMA = 1.0, 0.05


def _folder(seed, first_heading=0.0, ends=None, seconds=40.0, name="trolley"):
    """A trolley that turns as it goes round, 10 times a second ranges of all tags; `ends`: where those of a tag end."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, seconds, 0.1)
    phases = rng.uniform(0, 2 * np.pi, 3)
    centre = np.stack([1.2 * np.cos(0.3 * times + phases[0]), 1.2 * np.sin(0.4 * times + phases[1])], axis=1)
    heading = first_heading + 1.5 * (np.sin(0.35 * times + phases[2]) - np.sin(phases[2]))
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    ranges, truth = [], []
    for tag, offset in OFFSETS.items():
        place = centre + np.einsum("ijt,j->ti", turn, np.array(offset))
        end = place + np.einsum("ijt,j->ti", turn, np.array((ends or {}).get(tag, (0.0, 0.0))))
        zeros = np.zeros_like(times)
        pose = {"x_m": place[:, 0], "y_m": place[:, 1], "z_m": zeros + HEIGHT}
        pose |= {"qw": np.cos(heading / 2), "qx": zeros, "qy": zeros, "qz": np.sin(heading / 2)}
        truth.append(pl.DataFrame({"t_s": times, "tag": [tag] * len(times)} | pose))
        for anchor, corner in CORNERS.items():
            distance = np.sqrt(((end - corner[:2]) ** 2).sum(axis=1) + (HEIGHT - corner[2]) ** 2)
            ids = {"tag": [tag] * len(times), "anchor": [anchor] * len(times)}
            ranges.append(pl.DataFrame({"t_s": times, **ids, "range_m": distance + rng.normal(0, SIGMA, len(times))}))
    tags = {tag: Tag(HEIGHT, np.array([*offset, 0.0])) for tag, offset in OFFSETS.items()}
    rig = Rig(name, CORNERS, tags=tags, bodies={"trolley": tuple(OFFSETS)})
    tables = {"ranges": pl.concat(ranges).sort("t_s"), "truth": pl.concat(truth).sort("t_s")}
    return RecordingFolder(name, None, rig, tables)


@pytest.fixture(scope="module")
def folder():
    return _folder(1)


def test_position_and_heading_are_found_whatever_the_first_heading_with_covariances_that_hold():
    errors = []
    for seed, first in enumerate((0.0, 1.5, 3.0, -1.5)):
        folder = _folder(seed, first)
        named = tw.build("body", folder).with_values(
            {"sensors.ranges.sigma_r": SIGMA, "sensors.ranges.positive_skew": 1.0, "sensors.ranges.dof": 50.0}
            | {"sensors.ranges.bias": np.zeros(8), "motion.place.sigma_bias": 1e-3, "start.sigma_bias": 1e-3}
            | {"start.sigma_shared": 1e-3}
        )
        tracks = named.run(folder).to_polars().filter(pl.col("t_s") > 10.0)
        evaluation = tw.evaluate(tracks, folder)
        assert evaluation["rmse_m"] < 0.04
        assert evaluation["rmse_heading_rad"] < 0.1
        truth = folder.tables["truth"].filter(pl.col("tag") == "front")
        of_front = tracks.filter(pl.col("tag") == "front")
        heading = np.interp(of_front["t_s"], truth["t_s"], np.unwrap(2 * np.arctan2(truth["qz"], truth["qw"])))
        away = np.pi - (np.pi - (of_front["heading_rad"].to_numpy() - heading)) % (2 * np.pi)
        errors.append(away / of_front["std_heading_rad"].to_numpy())
    assert 0.85 < (np.abs(np.concatenate(errors)) < 1.96).mean() <= 1.0


def test_a_body_is_found_by_tags_of_which_none_hears_enough_anchors(folder):
    heard = {"front": ["A0", "A1"], "left": ["A1", "A2"], "right": ["A2", "A3"]}
    table = folder.tables["ranges"]
    few = pl.concat(table.filter((pl.col("tag") == tag) & pl.col("anchor").is_in(ids)) for tag, ids in heard.items())
    alone = dataclasses.replace(folder, tables=folder.tables | {"ranges": few.sort("t_s")})
    with pytest.raises(tw.UnusableInput, match="at least 3 anchors"):
        tw.build("uwb", alone)
    tracks = tw.build("body", alone).run(alone).to_polars().filter(pl.col("t_s") > 10.0)
    assert tw.evaluate(tracks, alone)["rmse_m"] < 0.1


def test_a_place_without_ranges_is_estimated_too(folder):
    tags = folder.rig.tags | {"tip": Tag(HEIGHT, np.array([0.5, 0.0, 0.0]))}
    rig = dataclasses.replace(folder.rig, tags=tags, bodies={"trolley": (*OFFSETS, "tip")})
    tracks = tw.build("body", folder).run(dataclasses.replace(folder, rig=rig)).to_polars()
    last = {row["tag"]: row for row in tracks.filter(pl.col("t_s") > 39.85).rows(named=True)}
    ahead = np.array([np.cos(last["tip"]["heading_rad"]), np.sin(last["tip"]["heading_rad"])])
    tip, front = (np.array([last[tag]["x_m"], last[tag]["y_m"]]) for tag in ("tip", "front"))
    assert np.allclose(tip - front, 0.2 * ahead, atol=0.02)


def test_calibration_finds_where_the_ranges_of_a_tag_end_and_headings_follow():
    ends = {"front": (0.01, -0.04), "left": (-0.03, -0.02), "right": (0.03, -0.02)}
    known = [_folder(seed, first, ends, name=f"known {seed}") for seed, first in ((11, 0.0), (12, 2.0), (13, 4.0))]
    calibration = calibrate(known)
    for tag, end in ends.items():
        found = calibration.tags[tag]
        assert (np.abs(np.array(found.offset) - end) < 3 * np.array(found.offset_sigmas)).all()
        assert max(found.offset_sigmas) < 0.01
    other = _folder(14, 1.0, ends)
    both = (other, other.calibrated(calibration))
    turned = [tw.evaluate(tw.build("body", f).run(f), f)["rmse_heading_rad"] for f in both]
    assert turned[1] < 0.8 * turned[0]


def test_bodies_of_a_rig_are_read_as_written_and_contradictions_refused(tmp_path):
    rig, path = _folder(0, seconds=1.0).rig, tmp_path / "rig.toml"
    path.write_text(rig_text(rig))
    assert read_rig(path)[0].bodies == {"trolley": ("front", "left", "right")}
    text = rig_text(rig)
    for old, new, expected in (
        ('left", "right"]', 'left", "rear"]', "tag 'rear' has no offset_m"),
        ('tags = ["front", "left", "right"]', 'tags = ["front"]', "expected at least 2 items"),
        ("[bodies", '[bodies.cart]\ntags = ["left", "right"]\n[bodies', "tag 'left' is named again"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        with pytest.raises(tw.UnusableInput, match=expected):
            read_rig(path)


def test_a_tag_on_no_body_is_refused(folder):
    tags = {**folder.rig.tags, "right": Tag(HEIGHT)}
    lone = dataclasses.replace(folder, rig=dataclasses.replace(folder.rig, tags=tags, bodies={}))
    with pytest.raises(tw.UnusableInput, match="found neither for right"):
        tw.build("body", lone)
    # A selection of one tag of several.
    with pytest.raises(tw.UnusableInput, match="found neither for front"):
        tw.build("body", Selection(("front",)).of(folder))
