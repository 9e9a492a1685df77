"""Leaving the line as a ROC: the second future work of chapter 4.

The thesis would detect it "by tracking the cumulative error between a standard Kalman filter and a map-constrained
filter". Here: the cumulative sum of their distance beyond a slack (`cusum`), for tags carried to a
position beside the line for `AWAY_S` seconds, or never. A detection is a sum above the limit while the tag is away or
within `AFTER_S` seconds; a false alarm is one at any time in a recording, of about a minute, of a tag that stays.
"""

from collections.abc import Callable, Iterator

import numpy as np

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.line_thesis import _assembly_line as line
from trackwright.experiments.text.expectations import fixed_interval, listed
from trackwright.sim.corruptions import gauss_markov, white_noise
from trackwright.sim.line import LineDraw
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import with_values
from trackwright.trackers.recordings.folder import RecordingFolder

NUMBERS = fitted("papers/line_thesis/table_3_1")
LEFT_S, AWAY_S, AFTER_S = 25.0, 10.0, 3.0
LEFT_SLACK, LEFT_LIMIT = 1.0, 2.0
TOWARDS = np.array([0.6, 0.8])
SIZES = {"0.5 m": 0.5, "0.75 m": 0.75, "1 m": 1.0, "2 m": 2.0}
STAYS = "stays"
SLACKS = (0.3, 0.5, LEFT_SLACK)
SHOWN_SLACK, FALSE_ALARMS = 0.5, 0.05
LIMITS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


def cusum(times: np.ndarray, distance: np.ndarray, slack: np.ndarray | float) -> np.ndarray:
    """The cumulative sum (Page 1954) of distance beyond `slack` m times seconds, (T,) m·s, never negative.

    `distance` (T,) m between a free and a constrained estimate at `times` (T,) s; NaN adds nothing.
    """
    excess = np.nan_to_num(np.asarray(distance, float) - slack) * np.diff(times, prepend=times[0])
    sums, total = np.zeros(len(excess)), 0.0
    for row, added in enumerate(excess):
        total = sums[row] = max(total + added, 0.0)
    return sums


def carried(ids: np.ndarray, seed: int, size: float, white: float) -> RecordingFolder:
    """Tags of situation 1, carried `size` m aside from second `LEFT_S` on; 0: never."""
    errors = {"white": white_noise(white), "slow": gauss_markov(NUMBERS["slow"], NUMBERS["tau"])}
    x, y = size * TOWARDS
    draw = LineDraw(
        "constant", errors, speed=NUMBERS["speed"], rate_hz=NUMBERS["rate_hz"],
        carried_off=(LEFT_S, LEFT_S + AWAY_S, (float(x), float(y))) if size > 0 else None,
    )  # fmt: skip
    return draw.drawn(ids, seed).folder(f"carried-{size}-{seed}")


_LAST: list[tuple[mc.TrackedRuns, np.ndarray]] = []
"""The distances found last: all measures use the same."""


def deviation(tracked: mc.TrackedRuns) -> np.ndarray:
    """The distances (n, T), m, between the constrained estimates and the free Kalman filter's."""
    if not (_LAST and _LAST[0][0] is tracked):
        (group,) = line.KALMAN.spec.batches([tracked.folder], "Kalman", False)
        tracker = with_values(group.tracker, {line.SIGMA: NUMBERS["sigma_kalman"]}, "leaving-line")
        trajectories = sorted(group.trajectories, key=lambda trajectory: int(trajectory.tag))
        estimates = tracker.run(stack([trajectory.recording for trajectory in trajectories]))
        free = np.stack([np.asarray(x) for x in estimates.mean.position], axis=-1)
        _LAST[:] = [(tracked, np.linalg.norm(free - tracked.estimates[..., :2], axis=-1))]
    return _LAST[0][1]


def _sums(tracked: mc.TrackedRuns, slack: float) -> np.ndarray:
    return np.stack([cusum(t, x, slack) for t, x in zip(tracked.times, deviation(tracked), strict=True)])


def _may_be_away(tracked: mc.TrackedRuns) -> np.ndarray:
    """Rows (n, T) in which an alarm counts as a detection."""
    return np.asarray((tracked.times >= LEFT_S) & (tracked.times < LEFT_S + AWAY_S + AFTER_S))


def _largest(slack: float, away: bool) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """Largest sum (n,), m·s, during the time away or over the whole recording."""

    def largest(tracked: mc.TrackedRuns) -> np.ndarray:
        rows = _may_be_away(tracked) if away else np.isfinite(tracked.times)
        return np.where(rows, _sums(tracked, slack), 0.0).max(axis=1)

    return largest


def _delay(limit: float) -> Callable[[mc.TrackedRuns], np.ndarray]:
    """Seconds (n,) from leaving to a sum above the limit; NaN without a detection."""

    def delay(tracked: mc.TrackedRuns) -> np.ndarray:
        over = _may_be_away(tracked) & (_sums(tracked, SHOWN_SLACK) >= limit)
        first = np.take_along_axis(tracked.times, over.argmax(axis=1)[:, None], axis=1)[:, 0]
        return np.where(over.any(axis=1), first - LEFT_S, np.nan)

    return delay


def _sums_of(results: mc.Results, world: str, tracker: str, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """The largest sums (n,), m·s, of tags that stay and, while they are away, of tags that leave."""
    stay = results.numbers(f"at any time, slack {slack}", STAYS, tracker)
    return stay, results.numbers(f"while away, slack {slack}", world, tracker)


def area(results: mc.Results, world: str, tracker: str, slack: float) -> mc.Value:
    """Area under the ROC: probability that the sum of a leaving tag exceeds a staying one's."""
    stay, leave = _sums_of(results, world, tracker, slack)
    wins = (leave[:, None] > stay[None, :]) + 0.5 * (leave[:, None] == stay[None, :])
    rng = np.random.default_rng(results.study.seed)
    weights = rng.multinomial(len(stay), np.full(len(stay), 1 / len(stay)), size=1000) / len(stay)
    # A tag has the same noise whether it leaves or stays; both are resampled together.
    return line.with_middle_95(wins.mean(), np.einsum("ri,ij,rj->r", weights, wins, weights, optimize=True))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """Detection rates and delays of tags that leave."""
    for tracker in results.study.trackers:
        areas = {world: area(results, world, tracker, SHOWN_SLACK) for world in SIZES}
        values = [a.value for a in areas.values()]
        says = f"{tracker}: the growing difference tells tags that left, the better the farther they are"
        how = "area under the ROC: " + ", ".join(f"{w} {fixed_interval(a, '.3f')}" for w, a in areas.items())
        yield mc.Conclusion(says, values[-1] > 0.95 and values == sorted(values), how, mc.PREDICTED)
        stay = results.numbers(f"at any time, slack {SHOWN_SLACK}", STAYS, tracker)
        limit = next((x for x in LIMITS if (stay >= x).mean() <= FALSE_ALARMS), LIMITS[-1])
        delays = {w: results.numbers(f"delay at {limit}", w, tracker) for w in SIZES}
        noticed = {w: d[np.isfinite(d)] for w, d in delays.items()}
        told = ", ".join(
            f"{w} {100 * len(d) / len(stay):.0f} %" + (f" after {np.median(d):.1f} s" if len(d) else "")
            for w, d in noticed.items()
        )
        false = (stay >= limit).mean()
        says = f"{tracker}: at most {100 * FALSE_ALARMS:.0f} % of recordings with a false alarm, and 2 m are noticed"
        how = f"slack {SHOWN_SLACK} m, limit {limit} m·s, the least that these recordings allow, "
        how += f"{100 * false:.1f} % false alarms; {told}"
        yield mc.Conclusion(says, bool(false <= FALSE_ALARMS and len(noticed["2 m"]) > 0.9 * len(stay)), how, mc.FITTED)
    usual = {w: 100 * (_sums_of(results, w, "grid", LEFT_SLACK)[1] >= LEFT_LIMIT).mean() for w in SIZES}
    false = (_sums_of(results, STAYS, "grid", LEFT_SLACK)[0] >= LEFT_LIMIT).mean()
    says = f"a slack of {LEFT_SLACK:g} m and a limit of {LEFT_LIMIT:g} m·s give next to no false alarms"
    how = f"{100 * false:.1f} %; noticed: {listed(usual, '{:.0f} %')}"
    yield mc.Conclusion(says, bool(false <= 0.01), how, mc.PREDICTED)


STUDY = mc.Study(
    name="leaving-line",
    about="How surely and how soon is it noticed that a tag has left its line, for how many false alarms?",
    worlds={
        name: mc.World(carried, {"size": size, "white": NUMBERS["white_1_2"]})
        for name, size in {STAYS: 0.0, **SIZES}.items()
    },
    trackers={
        "particle": line.with_noise(line.PARTICLE, NUMBERS["sigma_particle"]),
        "grid": line.with_noise(line.GRID_SEGMENT, NUMBERS["sigma_particle"]),
    },
    runs=200,
    measures={
        "error_m": line.error,
        **{f"at any time, slack {s}": _largest(s, away=False) for s in SLACKS},
        **{f"while away, slack {s}": _largest(s, away=True) for s in SLACKS},
        **{f"delay at {x}": _delay(x) for x in LIMITS},
    },
    metrics=("mean_m", "p95_m"),
    expected=expected,
)
