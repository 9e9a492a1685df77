"""The oracles agree with themselves at three sizes; the library agrees with them; the wrong estimators don't."""

import numpy as np
import pytest

from experiments.cli import verify
from experiments.verify import corridor, corridor_grid, halt, halt_grid
from experiments.verify.exact_checks import chain_findings, kalman_findings
from experiments.verify.findings import Finding, random, table
from experiments.verify.gradients import gradients, marginal_gradients
from experiments.verify.particle_checks import corridor_order_findings, halt_findings, halt_order_findings
from sim.corridor import corridor_fixes
from tests.in_process import trackwright
from trackers.core.particle.filter import ParticleFilter
from trackers.core.recording import Readings, Recording, stack
from trackers.line.fixes import FIXES

KEYS, PARTICLES = 64, 400


@pytest.mark.parametrize(
    ("rows", "value", "slope"), [(25, -75.183116463, -8.136640464), (100, -283.030498525, -48.889980552)]
)
def test_the_corridor_by_quadrature_is_the_same_at_three_sizes(rows, value, slope):
    fixes = corridor_fixes(rows)
    for points in ((48, 18), (64, 24), (96, 36)):
        assert corridor_grid.log_likelihood(fixes, points=points) == pytest.approx(value, abs=1e-8)
        assert corridor_grid.slopes(fixes, points)[0] == pytest.approx(slope, abs=1e-7)


def test_the_halt_by_quadrature_is_the_same_at_three_sizes():
    for points in ((128, 48), (160, 56), (192, 64)):
        assert halt_grid.log_likelihood(points=points) == pytest.approx(-13.7710834, abs=1e-6)
        assert halt_grid.slopes(points) == pytest.approx((0.235494, 6.516646, -0.180706), abs=1e-5)


def test_the_kalman_filter_and_the_chain_agree_with_their_oracles():
    findings = kalman_findings() + chain_findings()
    assert len(findings) == 8
    assert all(f.passed for f in findings), table(findings)


def _score(kind):
    tracker = corridor.corridor_tracker(corridor.corridor_filter(PARTICLES, kind))
    return gradients(tracker, corridor.corridor_batch(25, KEYS), corridor.TUNED).slopes[0]


def _apart(scores):
    """How many standard errors the mean is off."""
    return abs(scores.mean() - corridor_grid.slopes(corridor_fixes(25))[0]) / scores.std() * np.sqrt(len(scores))


@pytest.fixture(scope="module")
def scores():
    return _score(corridor.Boxed)


def test_the_score_form_sees_walls(scores):
    # The bias of 400 particles is a tenth of a standard error of 64 keys.
    assert _apart(scores) < 4


@pytest.mark.slow
@pytest.mark.parametrize("kind", [corridor.BoxedNaive, corridor.BoxedReparameterised])
def test_estimators_along_moves_do_not_see_walls(kind):
    assert _apart(_score(kind)) > 12


def _recording(rows, key):
    """The corridor's first fixes at these seconds, the fix of a second on the first of its rows."""
    fixes = np.vstack([np.zeros((1, 2)), corridor_fixes(25)])[rows]
    seen = np.concatenate([[False], np.diff(rows) > 0])
    return Recording(rows.astype(float), {FIXES: Readings(fixes, np.stack([seen] * 2, axis=1))}, name=f"key {key}")


@pytest.fixture(scope="module")
def marginal():
    """Marginal scores of all 25 fixes and of the first four, plain and with rows that take no time; 64 keys of each."""
    kinds = [np.arange(26), np.arange(5), np.array([0, 1, 1, 2, 3, 3, 4])]
    batch = stack([_recording(rows, key) for rows in kinds for key in range(KEYS)])
    tracker = corridor.corridor_tracker(corridor.corridor_filter(PARTICLES // 4))
    return np.split(marginal_gradients(tracker, batch, corridor.TUNED).slopes[0], 3)


@pytest.mark.slow
def test_the_marginal_score_scatters_less_than_half_as_much_as_the_same_particles_would(marginal, scores):
    # The bias of 100 particles, some 0.1 of −8.1, is one standard error.
    assert _apart(marginal[0]) < 5
    assert marginal[0].std() < 0.5 * 2 * scores.std()


@pytest.mark.slow
def test_rows_in_no_time_and_without_readings_do_not_change_the_marginal_score(marginal):
    _, plain, twice = marginal
    exact = corridor_grid.slopes(corridor_fixes(25)[:4])[0]
    for found in (plain, twice):
        assert abs(found.mean() - exact) < 4 * found.std() / np.sqrt(KEYS)


def test_the_marginal_score_is_refused_where_the_noise_does_not_reach_the_state():
    with pytest.raises(ValueError, match=r"(?s)LineMotion .* \(arclength has none\)"):
        marginal_gradients(halt.halt_tracker(ParticleFilter(10)), halt.halt_batch(1), halt.TUNED)


def _finding(mean, wrong=False):
    return Finding("world", "figure", "estimator", 1.0, mean, 0.1, wrong=wrong)


def test_verdicts_name_what_is_wrong_and_what_was_not_seen_to_fail():
    assert [_finding(m).verdict for m in (1.05, 1.2, np.nan)] == ["right", "WRONG", "WRONG"]
    assert [_finding(m, True).verdict for m in (1.2, 1.05, np.nan)] == [
        "fails, as it must", "NOT SEEN TO FAIL", "NOT SEEN TO FAIL",
    ]  # fmt: skip
    found = random("w", "f", "e", 0.0, np.array([-1.0, 1.0, 3.0, 1.0]))
    assert (found.mean, found.error, found.allowed) == pytest.approx((1.0, np.sqrt(8 / 3) / 2, 2 * np.sqrt(8 / 3)))


@pytest.mark.parametrize(("mean", "code", "word"), [(1.0, 0, "all as they must be"), (2.0, 1, "1 not as they must be")])
def test_verify_exits_1_where_a_figure_is_not_as_it_must_be(monkeypatch, mean, code, word):
    monkeypatch.setattr(verify, "CHECKS", (lambda: [_finding(mean)],))
    said = trackwright("verify")
    assert said.code == code
    assert word in said.out


@pytest.mark.slow
def test_all_400_keys_agree_at_a_halt_and_bias_and_spread_fall_as_they_must():
    findings = halt_findings() + corridor_order_findings() + halt_order_findings()
    assert all(f.passed for f in findings), table(findings)


@pytest.mark.slow
def test_the_whole_of_verify_passes():
    said = trackwright("verify")
    assert said.code == 0, said.out
    assert said.out.count("fails, as it must") == 3
