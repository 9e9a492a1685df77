"""Pieces of time in which the errors of readings count as one: those of the tag that moves most, for all tags."""

import numpy as np
import polars as pl
import pytest

from tests.tuning.calibration_worlds import lasting, walk
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.columns import PIECE_M, PIECE_S
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibration_pairs import calibration_pairs, differs_by_distance


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


def _errors(seed):
    """Distances, errors that last and pieces of 5 s of a walk of 4 min."""
    rng = np.random.default_rng(seed)
    times, positions = walk(rng, 240.0)
    distance = np.linalg.norm(positions[:, :2], axis=1)
    errors = lasting(rng, times, positions, 0.05) + 0.05 * rng.normal(size=len(times))
    errors[::60] += 2.0  # reflections
    return distance, errors, (times // 5).astype(int)


def _left_by_a_line(distance, errors):
    return errors - np.polyval(np.polyfit(distance, errors, 1), distance)


def test_errors_about_a_line_are_seldom_called_structure():
    found = 0
    for seed in range(40):
        distance, errors, piece = _errors(seed)
        found += differs_by_distance(distance, _left_by_a_line(distance, errors + 0.02 * distance), piece, 0.07)
    assert found <= 1


@pytest.mark.parametrize("seed", range(5))
def test_a_step_contradicts_a_line(seed):
    distance, errors, piece = _errors(seed)
    left = _left_by_a_line(distance, errors + 0.35 * (distance > 6))
    assert differs_by_distance(distance, left, piece, 0.07)
    # The same structure, but too small to matter beside errors of a metre.
    assert not differs_by_distance(distance, left, piece, 1.0)
