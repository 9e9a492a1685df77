"""Watches: scores without positions against dense algebra, the rate of false alarms, and each cause recovered."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lfilter

from trackwright.experiments.lab.validation.watch_worlds import (
    ERRORS,
    Change,
    behind_wall,
    changed,
    normal_operation,
    world_of,
)
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.kinds import KINDS, Measured
from trackwright.tuning.watch.normal import normal_of
from trackwright.tuning.watch.parity import Blocks, blocks_of
from trackwright.tuning.watch.readings import SLOT_S, Readings, Source, merged
from trackwright.tuning.watch.sequential import bank_of, course_of, threshold_of
from trackwright.tuning.watch.watching import site_of, watch, watch_runs

ONSET_S = 200.0


def _one_window(shift=0.0):
    """Ranges to five anchors at one time, about a position that is off."""
    random = np.random.default_rng(0)
    world = world_of(3, "ranges")
    rig = replace(world.rig, anchors=dict(list(world.rig.anchors.items())[:5]))
    kind, place = KINDS["ranges"], np.array([3.0, 2.5, 1.1])
    number = np.arange(5)[:, None]
    sensors = kind.sensors_of(rig, tuple(rig.anchors), number, 1)
    values = sensors.distances(np.tile(place, (5, 1))) + 0.05 * random.standard_normal((5, 1))
    measured = Measured(kind, tuple(rig.anchors), ("range_m",), values, sensors)
    positions = np.tile(place + shift, (5, 1))
    readings = Readings(measured, np.zeros(5), np.zeros(5, int), positions, np.zeros(5, bool), np.full((5, 1), 400.0))
    sources = tuple(Source("ranges", name, 4 * k) for k, name in enumerate(rig.anchors))
    return readings, sources


def test_scores_are_those_of_dense_algebra_with_the_position_projected_out():
    readings, sources = _one_window()
    blocks = blocks_of({"ranges": readings}, sources, 1.0, 1.0, (1.0, 0))
    anchors, at = readings.measured.sensors.places, readings.positions
    units = (at - anchors) / np.linalg.norm(at - anchors, axis=1, keepdims=True)
    G = np.zeros((5, 20))
    for k in range(5):
        G[k, 4 * k : 4 * k + 4] = [1.0, *-units[k]]
    W = 400.0 * np.eye(5)
    N = W - W @ units @ np.linalg.solve(units.T @ W @ units + np.eye(3), units.T @ W)
    errors = readings.measured.errors(at)[:, 0]
    np.testing.assert_allclose(blocks.information[0], G.T @ N @ G, atol=0.1)
    np.testing.assert_allclose(blocks.score[0], G.T @ N @ errors, atol=0.1)
    np.testing.assert_allclose(blocks.energy[0], errors @ N @ errors, rtol=1e-3)


def test_scores_do_not_depend_on_how_far_the_tracked_position_is_off():
    readings, sources = _one_window()
    (off, _) = _one_window(np.array([0.2, -0.15, 0.1]))
    right, wrong = (blocks_of({"ranges": r}, sources, 1.0, 1.0, (1.0, 3)).score for r in (readings, off))
    # The prior of 1 m on the shift costs some hundredths.
    np.testing.assert_allclose(wrong, right, atol=0.05 * np.abs(right).max())


def test_readings_of_a_source_in_a_window_are_merged_and_their_scores_stay():
    readings, sources = _one_window()
    often = readings.of_rows(np.repeat(np.arange(5), 4))
    off = np.linspace(-0.05, 0.05, 20)[:, None] * np.ones(3)
    moved = replace(often, positions=often.positions + off, weights=often.weights * np.linspace(0.5, 1.5, 20)[:, None])
    values = moved.measured.predicted(moved.positions) + 0.05 * np.random.default_rng(4).standard_normal((20, 1))
    moved = replace(moved, measured=moved.measured._replace(values=values))
    few = merged({"ranges": moved}, 1.0)["ranges"]
    assert len(few.times) == 5
    np.testing.assert_allclose(few.weights.sum(), moved.weights.sum())
    whole, less = (blocks_of({"ranges": r}, sources, 1.0, 1.0, (1.0, 0)) for r in (moved, few))
    np.testing.assert_allclose(less.score, whole.score, atol=0.05 * np.abs(whole.score).max())
    np.testing.assert_allclose(less.information, whole.information, atol=0.05 * whole.information.max())


def _correlated(count, keep, seed, source=None):
    """Blocks of one anchor with scores that are correlated from block to block, of information 100 each."""
    random = np.random.default_rng(seed)
    noise = lfilter([1.0], [1.0, -keep], np.sqrt(1 - keep**2) * random.standard_t(5, (count + 50, 4)), axis=0)[50:]
    information = np.tile(np.diag([100.0, 50.0, 50.0, 1e-3]), (count, 1, 1))
    score = noise * np.sqrt(np.einsum("bpp->bp", information))
    slots = np.arange(count)
    return Blocks(np.zeros(count, int), slots, np.zeros((count, 2), int), score, information, np.ones(count))


@pytest.mark.parametrize("keep", [0.0, 0.7])
def test_false_alarms_stay_below_the_stated_rate_with_correlated_blocks_counted_one_by_one(keep):
    sources = (Source("ranges", "A1", 0),)
    baseline = _correlated(600, keep, 1)
    normal = normal_of(baseline, np.zeros(600, int), sources)
    bank = bank_of(sources, normal, normal.corrected(baseline))
    # One alarm in 1,000 blocks of 5 s of all changes together.
    stated = 86400.0 / SLOT_S / 1000
    runs = [normal.corrected(_correlated(1000, keep, 10 + k)) for k in range(40)]
    courses = [course_of(run, bank, normal, stated) for run in runs]
    assert sum(course.alarm is not None for course in courses) <= 40
    # One change of one run, in plain numbers.
    counted, highest = 0.0, 0.0
    kappa, least = bank.scatter[0], bank.least[0]
    for g, F in zip(runs[0].score[:, 0], runs[0].information[:, 0, 0], strict=True):
        sigma = max((kappa / F) ** 0.5, least / 2)
        x = min(max(g / F, -3 * sigma), 3 * sigma)
        counted = max(counted + (least * x - least**2 / 2) / sigma**2, 0.0)
        highest = max(highest, counted)
    assert highest == pytest.approx(courses[0].statistic[:, 0].max())
    assert courses[0].threshold == pytest.approx(np.log(courses[0].statistic.shape[1] * 1000.0))


def test_a_shift_is_found_within_minutes():
    sources = (Source("ranges", "A1", 0),)
    normal = normal_of(_correlated(600, 0.5, 1), np.zeros(600, int), sources)
    bank = bank_of(sources, normal, normal.corrected(_correlated(600, 0.5, 1)))
    run = _correlated(400, 0.5, 2)
    after = (np.arange(400) >= 200)[:, None]
    run = run._replace(score=run.score + after * 3 * bank.least[0] * run.information[:, :, 0])
    course = course_of(normal.corrected(run), bank, normal, 1.0)
    assert course.alarm is not None
    assert 200 <= course.alarm < 320


def test_the_scatter_is_the_long_run_variance():
    # Of an autoregression with coefficient 0.7 it is (1 + 0.7) / (1 − 0.7) times the variance, and of Student's t of 5
    # degrees of freedom that is 5 / 3; the largest over stretches, of which long ones are few, is above that.
    sources = (Source("ranges", "A1", 0),)
    normal = normal_of(_correlated(4000, 0.7, 5), np.zeros(4000, int), sources)
    assert 0.8 * 9.4 < normal.scatter[0] < 2.0 * 9.4


def test_more_tags_and_changes_raise_the_threshold():
    one = _correlated(100, 0.0, 0)
    two = Blocks(*(np.concatenate([a, b]) for a, b in zip(one, one._replace(track=one.track + 1), strict=True)))
    assert threshold_of(two, 10, 1.0) == pytest.approx(threshold_of(one, 10, 1.0) + np.log(2.0))
    assert threshold_of(one, 20, 1.0) == pytest.approx(threshold_of(one, 10, 1.0) + np.log(2.0))


@cache
def _site(kind):
    world = world_of(2, kind)
    baseline, run = (normal_operation(world, name, 600.0, seed) for seed, name in enumerate(("baseline", "run")))
    return site_of(baseline), run


def test_normal_operation_is_no_change():
    site, run = _site("ranges, height known")
    found = watch_runs(site, run)
    assert not found.changed
    assert found.cause is None
    assert str(found).startswith("no change\n")


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        pytest.param(
            "ranges, height known",
            Change("moved", "ranges", ("A2",), np.array([0.6, -0.5, 0.0]), ONSET_S),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "ranges, height known", Change("delay", "ranges", ("A3",), np.array([0.5]), ONSET_S), marks=pytest.mark.slow
        ),
        ("ranges, height known", Change("drift", "ranges", ("A4",), np.array([0.003]), ONSET_S)),
        ("ranges, height known", Change("wall", "ranges", ("A1",), np.array([0.6]), ONSET_S)),
        ("ranges, height known", Change("swapped", "ranges", ("A2", "A5"), np.zeros(0), ONSET_S)),
        pytest.param(
            "bearings", Change("turned", "bearings", ("S2",), np.radians([12.0]), ONSET_S), marks=pytest.mark.slow
        ),
    ],
    ids=lambda x: x.name if isinstance(x, Change) else "",
)
def test_a_large_change_is_named_with_its_size_and_onset(kind, change):
    site, run = _site(kind)
    found = watch_runs(site, changed(run, change, 0))
    assert found.changed
    assert found.cause.name == change.name
    assert {source.name for source in found.cause.sources} == {*change.sources}
    # A wall is seen when the tag comes there.
    assert abs(found.onset_s - ONSET_S) <= (60.0 if change.name == "wall" else 15.0)
    assert found.alarm_s - ONSET_S < 180.0
    if change.name == "moved":
        assert np.all(np.abs(found.cause.size[:2] - change.size[:2]) < 2 * found.half_widths(found.cause)[:2])
    elif change.name in ("delay", "drift", "turned"):
        assert found.cause.size[0] == pytest.approx(change.size[0], rel=0.15)
    assert found.lines()[1].startswith("to do: ")


def test_changes_are_made_from_their_onset_on_alone():
    run = normal_operation(world_of(2, "ranges"), "run", 60.0, 1)
    change = Change("delay", "ranges", ("A3",), np.array([0.5]), 20.0)
    before, after = run.tables["ranges"], changed(run, change, 0).tables["ranges"]
    apart = (after["range_m"] - before["range_m"]).to_numpy()
    mine = (before["anchor"] == "A3").to_numpy() & (before["t_s"] >= 20.0).to_numpy()
    np.testing.assert_allclose(apart, 0.5 * mine, atol=1e-12)
    hidden = behind_wall(run.rig, "A3", run.tables["truth"].select("x_m", "y_m", "z_m").to_numpy(), 0)
    assert 0.1 < hidden.mean() < 0.6
    assert set(ERRORS) == {"m", "rad"}


def test_recordings_that_cannot_be_watched_are_refused_in_a_line():
    world = world_of(2, "ranges, height known")
    run, short = normal_operation(world, "run", 600.0, 1), normal_operation(world, "short", 30.0, 2)
    with pytest.raises(UnusableInput, match="a baseline of 30 s; expected 60 s"):
        watch(run, short)
    with pytest.raises(UnusableInput, match="smallest 0: expected a number above zero"):
        watch(run, short, smallest=0.0)
    with pytest.raises(UnusableInput, match="tables truth; expected ranges, tdoa or bearings"):
        watch(replace(run, tables={"truth": run.tables["truth"]}), short)
    with pytest.raises(UnusableInput, match="both named 'short'"):
        watch([short, short], run)
    moved = replace(short, rig=replace(short.rig, anchors={"A1": np.ones(3)}))
    site, _ = _site("ranges, height known")
    with pytest.raises(UnusableInput, match="anchor 'A1' stands elsewhere"):
        watch_runs(site, moved)
    with pytest.raises(UnusableInput, match="expected those of the baseline"):
        watch_runs(site, normal_operation(world_of(2, "bearings"), "other", 60.0, 2))
