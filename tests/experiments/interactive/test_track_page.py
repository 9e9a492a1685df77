"""The data of the page of `track`: what it holds is what the tables hold."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import polars as pl
import pytest

from experiments.interactive.decimation import drawn_rows, drawn_tracks
from experiments.interactive.packing import packed, script_json
from experiments.interactive.summaries import error_map
from experiments.interactive.track_page import page_data, track_page
from tests.experiments.interactive.small_tracks import BIAS, NASTY, TAGS, small_tracks
from trackers.evaluation import evaluate
from trackers.recordings.columns import float_column

NO_EVENTS = pl.DataFrame(
    schema={"recording": pl.String, "tag": pl.String, "t_s": pl.Float64, "event": pl.String, "detail": pl.String}
)


def _unpacked(array):
    return np.frombuffer(base64.b64decode(array["bdata"]), "<" + array["dtype"])


@pytest.fixture(scope="module")
def tracks():
    return small_tracks()


@pytest.fixture(scope="module")
def recording(tracks):
    event = pl.DataFrame({"recording": ["hall"], "tag": ["B"], "t_s": [5.0], "event": ["lost"], "detail": [""]})
    return page_data(tracks, event, None)["recordings"][0]


def test_the_columns_are_those_of_the_table(tracks, recording):
    rows = tracks.association.rows
    assert recording["rows"] == recording["drawn"] == len(rows)
    for name, column in (("v0", "x_m"), ("v1", "y_m"), ("s0", "std_x_m"), ("nis", "nis")):
        np.testing.assert_allclose(_unpacked(recording["columns"][name]), float_column(rows, column), rtol=1e-6)
    times = recording["start"] + _unpacked(recording["columns"]["t"])
    np.testing.assert_allclose(times, float_column(rows, "t_s"), rtol=1e-6)
    errors = float_column(rows, "x_m") - tracks.association.truth[:, 0]
    scored = tracks.association.scored
    np.testing.assert_allclose(_unpacked(recording["columns"]["e0"])[scored], errors[scored], rtol=1e-4, atol=1e-6)
    assert np.isnan(_unpacked(recording["columns"]["e0"])[~scored]).all()


def test_tracks_events_and_sources_are_named(recording):
    assert {track["tag"] for track in recording["tracks"]} == set(TAGS)
    (event,) = recording["events"]
    assert recording["tracks"][event["track"]]["tag"] == "B"
    assert recording["start"] + event["t"] == 5.0
    first = recording["tracks"][0]["first"]
    assert recording["sources"][_unpacked(recording["columns"]["source"])[first]] == "1"


def test_the_bias_of_an_anchor_is_its_median_residual_about_the_truth(recording):
    (channel,) = recording["residuals"]["channels"]
    boxes = dict(zip(channel["sources"], channel["boxes"]["true"], strict=True))
    assert boxes["2"][5] == pytest.approx(BIAS, abs=0.01)
    assert boxes["1"][5] == pytest.approx(0.0, abs=0.01)
    assert boxes["2"][2] == pytest.approx(0.02, rel=0.4)


def test_the_map_holds_the_root_mean_square_error_of_each_cell(tracks):
    (recording,) = tracks.recordings
    found = error_map(recording, np.zeros(2))
    squares, true = (recording.errors[:, :2] ** 2).sum(axis=1), recording.association.truth
    at = np.abs(true[:, None, 0] - found["x"]).argmin(axis=1), np.abs(true[:, None, 1] - found["y"]).argmin(axis=1)
    assert np.sum(found["count"]) == np.isfinite(squares).sum()
    for i, j in {(5, 3), *zip(*(x.tolist() for x in at), strict=True)}:
        own = (at[0] == i) & (at[1] == j) & np.isfinite(squares)
        expected = np.sqrt(np.mean(squares[own])) if own.any() else None
        assert found["rmse"][j][i] == (None if expected is None else pytest.approx(expected, rel=1e-3))


def test_the_calibration_of_correct_covariances_is_the_diagonal():
    recording = page_data(small_tracks(rows=900), NO_EVENTS, None)["recordings"][0]
    share = _unpacked(recording["calibration"]["curves"]["horizontal"]["share"])
    np.testing.assert_allclose(share, np.arange(101), atol=4)


def test_decimated_rows_keep_ends_and_peaks():
    lengths, weight = np.array([500, 7, 1000]), np.random.default_rng(2).random(1507)
    weight[[123, 1200]] = 9.0
    drawn = drawn_rows(lengths, weight, 200)
    assert 100 < len(drawn) <= 230
    assert {0, 499, 500, 506, 507, 1506, 123, 1200} <= set(drawn.tolist())
    assert np.all(np.diff(drawn) > 0)
    np.testing.assert_array_equal(drawn_rows(lengths, weight, 2000), np.arange(1507))


def test_of_many_tracks_the_worst_the_median_and_the_best_are_drawn():
    order = [int(k) for k in np.random.default_rng(3).permutation(101)]
    drawn = drawn_tracks(order, 11)
    assert len(drawn) == 11
    assert {order[0], order[50], order[100]} <= set(drawn)


def test_a_long_recording_is_decimated_within_the_size_of_a_page():
    tracks = small_tracks(rows=500, tags=tuple(f"tag-{k}" for k in range(200)))
    text = track_page(tracks, NO_EVENTS, None, "uwb", "trackwright track hall")
    assert len(text.encode()) < 8e6
    (recording,) = page_data(tracks, NO_EVENTS, None)["recordings"]
    assert recording["rows"] == 100_000
    assert recording["drawn"] <= 25_400


def test_no_text_of_a_user_ends_a_script_or_becomes_markup(tracks):
    text = track_page(
        tracks, NO_EVENTS, evaluate(tracks.association, tracks.folders), f"mine {NASTY}", f"track {NASTY}"
    )
    assert NASTY not in text

    class Scripts(HTMLParser):
        data, kinds, inside = "", [], False

        def handle_starttag(self, tag, attrs):
            if tag == "script":
                self.kinds.append(dict(attrs).get("type"))
                self.inside = self.kinds[-1] == "application/json"

        def handle_data(self, data):
            self.data += data if self.inside else ""

        def handle_endtag(self, tag):
            self.inside = False

    parser = Scripts()
    parser.feed(text)
    assert parser.kinds == ["application/json", None, None, None]
    assert json.loads(parser.data)["command"] == f"track {NASTY}"
    assert not re.search(r'(src|href)="', text[: text.index('<script type="application/json"')])


def test_json_of_a_script_holds_what_was_given():
    content = {"a": "</script><!--", "b": [1.5, None, "ü"]}
    assert json.loads(script_json(content)) == content
    assert "<" not in script_json(content)
    np.testing.assert_array_equal(_unpacked(packed(np.array([1.0, np.nan, 1e300]))), np.float32([1, np.nan, np.inf]))
