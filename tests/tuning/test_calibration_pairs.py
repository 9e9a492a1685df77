"""Pieces of time in which the errors of readings count as one: those of the tag that moves most, for all tags."""

import numpy as np
import polars as pl
import pytest

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.columns import PIECE_M, PIECE_S
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import calibration_pairs


@pytest.mark.parametrize("first", ["moving", "still"])
def test_pieces_are_those_of_the_tag_that_moves_most_for_all_tags_of_a_body(first):
    times, speed = 0.5 * np.arange(121), 0.5
    moving = np.stack([speed * times, 0 * times, 0 * times], axis=1)
    places = {"moving": moving, "still": moving[:1] + 0 * moving}
    tags = dict(zip("ab", sorted(places, key=lambda name: name != first), strict=True))
    tables = {"truth": [], "ranges": []}
    for tag, name in tags.items():
        at = {"t_s": times, "tag": [tag] * len(times)}
        tables["truth"].append(pl.DataFrame(at | {f"{a}_m": places[name][:, k] for k, a in enumerate("xyz")}))
        far = np.linalg.norm(places[name] - [5.0, 9.0, 2.0], axis=1)
        tables["ranges"].append(pl.DataFrame(at | {"anchor": ["A"] * len(times), "range_m": far}))
    folder = RecordingFolder(
        "hall", None, Rig("hall", anchors={"A": np.array([5.0, 9.0, 2.0])}),
        {name: pl.concat(parts).sort("t_s", maintain_order=True) for name, parts in tables.items()},
    )  # fmt: skip
    pairs = calibration_pairs([folder], KINDS["ranges"])["A"]
    # 60 s at 0.5 m/s: a piece for every 5 s, in which the tag moves more than 1 m
    assert PIECE_S * speed > PIECE_M
    for tag in tags:
        assert len(np.unique(pairs.piece[pairs.tag == tag])) == pytest.approx(60 / PIECE_S, abs=1)
