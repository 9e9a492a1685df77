import numpy as np
import polars as pl
import pytest
from scipy.signal import lfilter

import trackwright as tw
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.evaluate import evaluate_association
from trackwright.trackers.evaluation.protection import conformal_factor, largest_sigma, protection
from trackwright.trackers.recordings.truth import TruthStatus

RATE_HZ, SPEED = 2.0, 0.5


def _session(rng: np.random.Generator, seconds: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """A straight walk at `SPEED` (n, 2), m, and estimates of it whose errors last for 2 s, of `scale` standard
    deviations of 0.1 m each and of Student's t of 5 degrees of freedom."""
    n = int(seconds * RATE_HZ)
    memory = np.exp(-1 / (2.0 * RATE_HZ))
    noise = rng.standard_t(5, (n, 2)) * np.sqrt(3 / 5)
    errors = 0.1 * scale * lfilter([np.sqrt(1 - memory**2)], [1.0, -memory], noise, axis=0)
    path = np.stack([SPEED / RATE_HZ * np.arange(n), np.zeros(n)], axis=1)
    return path, path + errors


def _associated(sessions: dict[str, tuple[np.ndarray, np.ndarray]]) -> Association:
    tables = [
        pl.DataFrame(
            {
                "recording": [name] * len(path),
                "tag": ["0"] * len(path),
                "t_s": np.arange(len(path)) / RATE_HZ,
                "x_m": found[:, 0],
                "y_m": found[:, 1],
                "std_x_m": np.full(len(path), 0.1),
                "std_y_m": np.full(len(path), 0.1),
                "cov_xy_m2": np.zeros(len(path)),
            }
        )
        for name, (path, found) in sessions.items()
    ]
    truth = np.concatenate([np.column_stack([path, np.zeros(len(path))]) for path, _ in sessions.values()])
    starts = np.cumsum([0, *(len(path) for path, _ in sessions.values())])
    return Association(pl.concat(tables), truth, np.full(len(truth), TruthStatus.SCORED, np.uint8), starts)


def test_the_factor_is_the_smallest_that_holds_the_share_of_the_next_block():
    rng = np.random.default_rng(3)
    blocks = [rng.exponential(size=n) for n in (1, 7, 30, 4, 11)]
    for share in (0.5, 0.7, 0.8):
        # By the definition: mean of the blocks' shares with one block more, of which nothing is held.
        candidates = np.sort(np.concatenate(blocks))
        held = [np.mean([*(np.mean(b <= k) for b in blocks), 0.0]) for k in candidates]
        assert conformal_factor(blocks, share) == candidates[np.argmax(np.array(held) >= share - 1e-12)]
    assert conformal_factor(blocks, 0.84) == np.inf


def test_the_largest_standard_deviation_is_the_root_of_the_larger_eigenvalue():
    rng = np.random.default_rng(4)
    factors = rng.normal(size=(50, 2, 2))
    P = factors @ factors.transpose(0, 2, 1)
    rows = pl.DataFrame({"std_x_m": P[:, 0, 0] ** 0.5, "std_y_m": P[:, 1, 1] ** 0.5, "cov_xy_m2": P[:, 0, 1]})
    np.testing.assert_allclose(largest_sigma(rows), np.linalg.eigvalsh(P)[:, 1] ** 0.5, rtol=1e-6)
    assert np.isnan(largest_sigma(pl.DataFrame({"std_x_m": [0.0], "std_y_m": [0.0], "cov_xy_m2": [0.0]}))).all()


@pytest.mark.parametrize("probability", [0.8, 0.95])
def test_levels_hold_the_stated_share_of_sessions_never_seen(probability):
    """Of 150 sites whose covariances are too small or too large by factors of up to two."""
    held, refused = [], 0
    for seed in range(150):
        rng = np.random.default_rng([seed, 11])
        scale = np.exp(rng.uniform(-0.7, 0.7))
        seen = {name: _session(rng, 150, scale) for name in ("a", "b", "c")}
        try:
            level = protection(_associated(seen), [], probability)
        except tw.UnusableInput:
            refused += 1
            continue
        path, found = _session(rng, 150, scale)
        held.append(np.mean(np.hypot(*(found - path).T) <= 0.1 * level.factor))
    error = np.std(held) / np.sqrt(len(held))
    # Sessions are alike: to call one different is a false alarm.
    assert refused <= 3
    assert probability - 3 * error <= np.mean(held) <= probability + 0.03


def test_the_level_of_a_row_is_a_column_and_its_evidence_is_stated():
    rng = np.random.default_rng(5)
    association = _associated({name: _session(rng, 150, 1.5) for name in ("a", "b")})
    level = protection(association, [], 0.9)
    assert level.blocks == 60
    assert level.rows == 600
    assert all(0.8 < share <= 1.0 for share in level.held.values())
    assert "for 90 %; from 600 rows in 60 independent blocks of 2 recordings" in str(level)
    tracks = level.applied(association.rows.with_columns(std_x_m=pl.when(pl.col("t_s") > 0).then(0.1)))
    np.testing.assert_allclose(tracks["pl_m"].drop_nulls(), 0.1 * level.factor, rtol=1e-6)
    assert tracks["pl_m"].null_count() == 2
    changed = level.applied(association.rows, {"b": 100.0})["pl_m"].to_numpy()
    since = ((association.rows["recording"] == "b") & (association.rows["t_s"] >= 100.0)).to_numpy()
    assert since.any()
    np.testing.assert_array_equal(np.isinf(changed), since)
    scored = evaluate_association(association._replace(rows=tracks), {})
    errors = np.hypot(*(association.rows[f"{a}_m"].to_numpy() - association.truth[:, k] for k, a in enumerate("xy")))
    exceeded = (errors > tracks["pl_m"].fill_null(np.inf).to_numpy()).sum() / 598
    assert scored["pl_exceeded"] == pytest.approx(exceeded)
    assert scored["pl_m"] == pytest.approx(0.1 * level.factor)


def test_what_the_recordings_cannot_support_is_refused():
    rng = np.random.default_rng(6)
    alike = {name: _session(rng, 100, 1.0) for name in ("a", "b")}
    with pytest.raises(tw.UnusableInput, match=r"99.9 % takes 999 independent .* a 20, b 20.* of 0.952 at most"):
        protection(_associated(alike), [])
    assert protection(_associated(alike), [], 0.95).factor > 2.0
    with pytest.raises(tw.UnusableInput, match="1 recording with truth"):
        protection(_associated({"a": alike["a"]}), [], 0.8)
    with pytest.raises(tw.UnusableInput, match="expected a number from 0.5"):
        protection(_associated(alike), [], 1.0)
    other = {**alike, "c": _session(rng, 100, 4.0)}
    with pytest.raises(tw.UnusableInput, match=r"holds .* % of c, expected 90 %"):
        protection(_associated(other), [], 0.9)
