"""The reproductions of systems C and D: their worlds, their measures, and their claims on a handful of runs."""

from dataclasses import replace

import numpy as np
import pytest

from tests.oracles import distances_to_path
from trackwright.experiments.lab.papers import fitting
from trackwright.experiments.lab.papers.fitting import fitted, solved, unsaved
from trackwright.experiments.lab.papers.huang_2018 import mhk_against, workshop
from trackwright.experiments.lab.papers.kwon_2021 import chamber, line_of_sight, robot, table_4
from trackwright.experiments.monte_carlo.tracked import TrackedRuns
from trackwright.experiments.text.expectations import PREDICTED, ExpectedResult
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.mhk.tracker import STILL


def _run(estimates, truth, folder=None):
    """What a measure sees of positions (n, T, 3) at 10 rows a second."""
    n, rows = estimates.shape[:2]
    times = np.tile(np.arange(rows) / 10.0, (n, 1))
    nothing = np.zeros((n, rows))
    return TrackedRuns(
        times, estimates, nothing[..., None, None], truth, nothing == 0, nothing, nothing, nothing, folder
    )


def test_a_fit_finds_the_parameters_at_which_the_ratios_are_one():
    found = solved(
        lambda n: np.array([n["x"] * n["y"] / 6.0, n["x"] / n["y"] ** 2 * 3.0]), {"x": 1.0, "y": 1.0}, rounds=20
    )
    # x y = 6 and 3 x = y²: y³ = 18; the fit stops at steps of a thousandth.
    np.testing.assert_allclose([found["x"], found["y"]], [6 / 18 ** (1 / 3), 18 ** (1 / 3)], rtol=2e-3)


def test_a_fit_of_an_unknown_name_is_refused_with_the_names_there_are():
    with pytest.raises(UnusableInput, match="'papers/kwon_2021/table_5': unknown; expected one of .*kwon_2021/table_4"):
        fitting.main("papers/kwon_2021/table_5")


@pytest.mark.slow
@pytest.mark.parametrize("module", [chamber, line_of_sight, table_4], ids=lambda m: m.STUDY.name)
def test_at_the_fitted_parameters_our_numbers_are_the_printed_ones(module):
    numbers = fitted("/".join(module.__name__.split(".")[3:]))
    # A fit that has more printed numbers than it can reach, ends within some per cent of them.
    np.testing.assert_allclose(module.fit.ratios(numbers), 1.0, atol=0.03)


def test_the_raw_fixes_of_the_workshop_are_as_far_off_the_route_as_its_polyline_says():
    numbers = {name: fitted("papers/huang_2018/workshop")[name] for name in ("drift", "share", "size")}
    folder = workshop.workshop(np.arange(2), 3, **numbers)
    fixes = folder.tables["fixes"].filter(tag="1").select("x_m", "y_m").to_numpy()[:100]
    empty = np.zeros((2, 2000, 3))
    ours = workshop.raw_off_route(_run(empty, empty, folder))[1, :100]
    # The rig's knots are 5 cm apart, which is 0.3 mm off in corners.
    np.testing.assert_allclose(ours, distances_to_path(fixes, folder.rig.path_knots), atol=4e-4)


@pytest.mark.slow
def test_the_workshop_has_nine_printed_figures_of_which_four_are_predicted():
    found = list(workshop.expected(unsaved(replace(workshop.STUDY, runs=4))))
    claims = [c for c in found if isinstance(c, ExpectedResult)]
    assert [c.origin for c in claims].count(PREDICTED) == 4
    assert [c.share for c in claims] == [c.unit == "%" for c in claims]
    assert len(claims) == 9
    # Four vehicles: their largest errors spread by 15 %, so that the mean of four is off by 25 % in 1 of 1,000 cases.
    assert all(abs(c.ours.value / c.printed - 1) < 0.25 for c in claims)


def test_successive_medians_of_a_tag_at_rest_differ_by_the_smaller_noise_of_a_displacement():
    noise = np.random.default_rng(0).normal(size=20_000) * np.sqrt(STILL[0, 0])
    medians = np.median(np.lib.stride_tricks.sliding_window_view(noise, 9), axis=1)
    # 20,000 correlated differences know a standard deviation to 1 %.
    assert np.diff(medians).std() == pytest.approx(mhk_against.CLOSER_M, rel=0.06)


def test_the_chambers_anchors_are_five_metres_apart_and_none_hangs_over_a_tag():
    anchors = chamber.anchors(2.5)
    np.testing.assert_allclose(np.linalg.norm(np.diff(anchors, axis=0), axis=1), 5.0)
    tags = np.array(list(chamber.PLACES.values()))
    assert np.linalg.norm(anchors[:, None, :2] - tags[None, :, :2], axis=-1).min() > 0.5


def test_a_tag_found_above_the_anchors_is_taken_for_its_mirror_image():
    folder = chamber.corner(np.arange(1), 0, (0.0, 0.0, 1.8), 0.0, 2.5)
    truth = np.tile([0.0, 0.0, 1.8], (1, 3, 1))
    found = truth + [[[0.0, 0.1, 0.0], [0.0, 0.0, 1.4], [0.2, 0.0, 1.3]]]
    off = chamber.deviations(_run(found, truth, folder))
    np.testing.assert_allclose(off[0], [[0.0, 0.1, 0.0], [0.0, 0.0, 0.0], [0.2, 0.0, 0.1]], atol=1e-12)


def test_the_robot_goes_from_end_to_end_of_every_axis_without_a_jump():
    path = robot.strokes(np.zeros(1), np.arange(0.0, 60.0, 0.1))[0]
    np.testing.assert_allclose(path.min(axis=0), robot.LOW, atol=1e-12)
    np.testing.assert_allclose(path.max(axis=0), robot.HIGH, atol=1e-12)
    # A stroke of 0.39 m there and back in 4 s is 0.31 m/s at most.
    assert np.abs(np.diff(path, axis=0)).max() < 0.032


def test_the_ends_of_strokes_are_measured_by_the_mean_of_what_was_estimated():
    truth = robot.strokes(np.zeros(1), np.arange(0.0, 60.0, 0.1))
    tracked = _run(truth + [0.03, -0.02, 0.05], truth, robot.robot(np.arange(1), 0, 0.0, 2.5))
    off = {name: float(measure(tracked)[0]) for name, measure in robot.STUDY.measures.items()}
    expected = {"flat_m": 0.025, "height_m": 0.05}
    expected |= {
        f"{end}_{a}_m": e for end in ("least", "largest") for a, e in zip("xyz", (0.03, 0.02, 0.05), strict=True)
    }
    assert off == pytest.approx(expected, abs=1e-9)


def test_a_still_tags_fixes_come_of_its_ranges():
    numbers = {k: v for k, v in fitted("papers/kwon_2021/table_4").items() if k != "sigma_a"}
    folder = table_4.still(np.arange(2), 0, **numbers)
    fixes = folder.tables["fixes"]
    assert len(fixes) == 2 * (table_4.SETTLING + table_4.SCORED)
    assert set(folder.tables) == {"ranges", "imu", "fixes", "truth"}
    off = fixes.select("x_m", "y_m").to_numpy() - table_4.TAG[:2]
    # Ranges are off by 1 cm, and nothing of it is a bias.
    assert np.abs(off.mean(axis=0)).max() < 0.005
    assert np.abs(off).max() < 0.06
