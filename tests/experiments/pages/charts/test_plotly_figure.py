"""A chart as data for plotly.js: the numbers, names and scales that matplotlib drew."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.experiments.pages.charts.small_runs import chart_data
from trackwright.experiments.pages.charts.plotly_figure import plotly_figure
from trackwright.experiments.pages.charts.style import Chart

X = np.array([0.5, 1.0, 2.0])


@pytest.fixture
def axes():
    return Figure().subplots()


def _figure(axes):
    return plotly_figure(axes.figure)


def test_lines_keep_their_numbers_names_and_gaps(axes):
    axes.plot(X, [1.0, np.nan, 3.0], color="#0072b2", linestyle="--", label="a <b> $")
    axes.plot(X, X, "o", markerfacecolor="white", color="#d55e00", label="_unnamed")
    axes.legend()
    axes.set(xlabel="time (s)", xlim=(0, 3))
    line, marks = _figure(axes)["data"]
    assert (line["x"], line["y"]) == ([0.5, 1.0, 2.0], [1.0, None, 3.0])
    assert (line["name"], line["showlegend"], line["mode"]) == ("a &lt;b&gt; $", True, "lines")
    assert line["line"] == {"color": "rgba(0,114,178,1)", "width": 1.5, "dash": "dash"}
    assert (marks["mode"], marks["showlegend"], marks["marker"]["symbol"]) == ("markers", False, "circle-open")
    assert marks["marker"]["color"] == "rgba(213,94,0,1)"
    layout = _figure(axes)["layout"]
    assert (layout["xaxis"]["title"]["text"], layout["xaxis"]["range"], layout["showlegend"]) == (
        "time (s)",
        [0, 3],
        True,
    )


def test_bands_histograms_and_lines_across_keep_their_places(axes):
    axes.fill_between(X, X - 1, X + 1)
    axes.stairs([3.0, 1.0], [0.0, 1.0, 4.0], fill=True)
    axes.axhline(2.0)
    axes.set_xlim(0, 4)
    band, bars, across = _figure(axes)["data"]
    assert (min(band["y"]), max(band["y"]), set(band["x"])) == (-0.5, 3.0, set(X))
    assert (bars["x"], bars["y"]) == ([0, 0, 1, 1, 4, 4], [0, 3, 3, 1, 1, 0])
    assert (across["x"], across["y"]) == ([0, 4], [2, 2])


def test_spans_are_shown_where_they_are(axes):
    axes.axvspan(1.0, 1.5, label="times")
    axes.axhspan(2.0, 3.0)
    axes.set(xlim=(0, 4), ylim=(0, 5))
    spans = _figure(axes)["data"]
    corners = [(min(span["x"]), max(span["x"]), min(span["y"]), max(span["y"])) for span in spans]
    np.testing.assert_allclose(corners, [(1, 1.5, 0, 5), (0, 4, 2, 3)], atol=1e-12)
    assert [span["name"] for span in spans if span["showlegend"]] == ["times"]


@pytest.mark.parametrize(
    ("draw", "what"),
    [
        (lambda axes: axes.imshow(np.outer(X, X)), "AxesImage"),
        (lambda axes: axes.pie([1.0]), "Wedge"),
        (lambda axes: axes.scatter(X, X), "PathCollection"),
        (lambda axes: axes.quiver(X, X, X, X), "Quiver"),
        (lambda axes: axes.plot(X, X, "*", label="stars"), "marker '[*]' of 'stars'"),
    ],
)
def test_what_a_page_cannot_show_is_refused_and_named(axes, draw, what):
    axes.set_title("errors", loc="left")
    draw(axes)
    with pytest.raises(TypeError, match=f"chart 'errors': {what}.*; expected .+; draw"):
        _figure(axes)


def test_a_logarithmic_axis_and_names_of_rows_are_kept(axes):
    axes.plot(X, [0, 1, 2], "s")
    axes.set_xscale("log")
    axes.set(xlim=(0.1, 10))
    axes.set_yticks([0, 1, 2], ["kalman", "window & sons", "c"])
    layout = _figure(axes)["layout"]
    assert (layout["xaxis"]["type"], layout["xaxis"]["range"]) == ("log", [-1, 1])
    assert layout["yaxis"]["ticktext"] == ["kalman", "window &amp; sons", "c"]
    assert layout["yaxis"]["tickvals"] == [0, 1, 2]


def test_words_at_points_are_kept_and_arrows_are_not(axes):
    axes.plot(X, X)
    axes.set_xscale("log")
    words = {"textcoords": "offset points", "va": "top", "ha": "right", "color": "#0072b2"}
    axes.annotate(r"A<1>\$", (100.0, 2.0), (0, -7), **words)
    axes.annotate("", (1.0, 1.0), (2.0, 2.0), arrowprops={"arrowstyle": "->"})
    (label,) = _figure(axes)["layout"]["annotations"]
    assert (label["x"], label["y"], label["text"], label["showarrow"]) == (2.0, 2.0, "A&lt;1&gt;$", False)
    assert (label["xanchor"], label["yshift"] < 0, label["font"]["color"]) == ("right", True, "rgba(0,114,178,1)")


def test_contours_and_several_panels_stay_images(axes):
    axes.contourf(np.outer(X, X))
    assert _figure(axes) is None
    several = Figure()
    several.subplots(2, 1)
    assert plotly_figure(several) is None


def test_an_image_of_a_page_holds_its_data():
    data = chart_data(Chart("a", "A", lambda axes: axes.plot(X, X, label="</metadata> & <script>")).address)
    assert data["data"][0]["y"] == X.tolist()
    assert data["data"][0]["name"] == "&lt;/metadata&gt; &amp; &lt;script&gt;"
