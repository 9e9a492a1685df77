"""Protection levels: the share of sessions never seen that they hold, at simulated sites and on real recordings.

Simulated: five sessions of a site with truth and a sixth, whose errors are of Student's t of 5 degrees of freedom, last
for 2 s, and are 0.5 to 2 times as large as the reported standard deviation says, the same in all sessions or not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import polars as pl
from scipy.signal import lfilter

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.validation.sites import recorded
from trackwright.experiments.text.terminal import progress
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.association import Association
from trackwright.trackers.evaluation.evaluate import associate, evaluate_association
from trackwright.trackers.evaluation.protection import protection
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.truth import TruthStatus
from trackwright.tuning.calibrating import calibrate

SITES, SESSIONS = 200, 5
PROBABILITIES = (0.8, 0.9, 0.95, 0.99, 0.999)
SPREADS = (0.0, 0.2, 0.4)
"""Standard deviations of the logarithm of the errors' size between sessions."""

SIGMA, DOF, LASTS, RATE_HZ, SPEED = 0.1, 5, 2.0, 2.0, 0.5
SECONDS = 300.0
"""Duration of a session with 60 blocks; those for 99 and 99.9 % are longer by what these take."""

OF_WALKS = (0.8, 0.9)
"""Probabilities that the evidence of five walks supports."""

WALKS = tuple(f"ble51-walk-u{use}-r{run}" for use in (1, 2, 3) for run in (1, 2))


def protection_levels(*, output: Output = DEFAULTS) -> int:
    """The share of sessions never seen that protection levels hold; 1 where alike sessions are held too seldom."""
    keep_programs()
    rows = []
    kinds = [(probability, spread) for probability in PROBABILITIES for spread in SPREADS]
    sites = 10 if output.small else SITES
    with progress("sites", len(kinds) * sites) as advance:
        for probability, spread in kinds:
            rows.append(_simulated(probability, spread, sites))
            advance(sites)
    tables = [Table(rows, "Simulated sites", note="Held: mean over sites, ± its standard error.")]
    if not output.small:
        walks = recorded(WALKS)
        of_walks = [row for walk in walks for row in _real(walks, walk)]
        tables.append(Table(sorted(of_walks, key=lambda row: row["stated %"]), "Bluetooth walks"))
    output.publish("validation protection-levels", *tables)
    alike = [row for row in rows if row["sessions differ by"] == 0.0]
    return int(any(row["held %"] + 3 * row["±"] < row["stated %"] for row in alike))


def _simulated(probability: float, spread: float, sites: int) -> Row:
    """What levels of a probability hold of a session more, over sites whose sessions differ by `spread`."""
    seconds = SECONDS * max(1.0, 0.02 / (1.0 - probability))
    held, factors, refused = [], [], 0
    for site in range(sites):
        rng = np.random.default_rng([site, int(1e4 * probability), int(10 * spread)])
        size = np.exp(rng.uniform(-0.7, 0.7))
        sizes = size * np.exp(spread * rng.normal(size=SESSIONS + 1))
        try:
            level = protection(_associated([_errors(rng, seconds, one) for one in sizes[1:]]), [], probability)
        except UnusableInput:
            refused += 1
            continue
        held.append(np.mean(np.hypot(*_errors(rng, seconds, sizes[0]).T) <= SIGMA * level.factor))
        factors.append(level.factor / size)
    shares = 100 * np.array(held)
    return {
        "stated %": 100 * probability,
        "sessions differ by": spread,
        "refused %": 100 * refused / sites,
        "held %": float(shares.mean()) if held else None,
        "±": float(shares.std(ddof=1) / np.sqrt(len(held))) if len(held) > 1 else None,
        "lowest of 20 sites %": float(np.quantile(shares, 0.05)) if held else None,
        "factor / size": float(np.median(factors)) if held else None,
    }


def _errors(rng: np.random.Generator, seconds: float, size: float) -> np.ndarray:
    """Horizontal errors (n, 2), m, that last for `LASTS` s."""
    memory = np.exp(-1.0 / (LASTS * RATE_HZ))
    noise = rng.standard_t(DOF, (int(seconds * RATE_HZ), 2)) * np.sqrt((DOF - 2) / DOF)
    errors: np.ndarray = SIGMA * size * lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], noise, axis=0)
    return errors


def _associated(sessions: Sequence[np.ndarray]) -> Association:
    """Estimates with these errors of a tag on a straight way, a recording for each session, with the truth."""
    lengths = [len(errors) for errors in sessions]
    t = np.concatenate([np.arange(n) / RATE_HZ for n in lengths])
    truth = np.stack([SPEED * t, np.zeros(len(t)), np.zeros(len(t))], axis=1)
    places = truth[:, :2] + np.concatenate(sessions)
    rows = pl.DataFrame({"recording": np.repeat([f"{k}" for k in range(len(lengths))], lengths), "t_s": t})
    sigmas = {f"std_{axis}_m": pl.lit(SIGMA) for axis in "xy"}
    rows = rows.with_columns(pl.lit("0").alias("tag"), x_m=places[:, 0], y_m=places[:, 1], cov_xy_m2=0.0, **sigmas)
    status = np.full(len(t), TruthStatus.SCORED, np.uint8)
    return Association(rows, truth, status, np.cumsum([0, *lengths]))


def _real(walks: Sequence[RecordingFolder], judged: RecordingFolder) -> Iterator[Row]:
    """What levels hold of a walk, from the others, each calibrated on all but itself and the judged one."""
    others = [walk for walk in walks if walk is not judged]
    parts = [_tracked(walk, [x for x in others if x is not walk]) for walk in others]
    evidence = Association.joined(sorted(parts, key=lambda x: x.rows["recording"][0]))
    mine = _tracked(judged, others)
    for probability in OF_WALKS:
        row: Row = {"walk": judged.name, "stated %": 100 * probability, "held %": None, "PL median m": None}
        try:
            rows = protection(evidence, [], probability).applied(mine.rows)
        except UnusableInput as problem:
            yield row | {"refused": str(problem).partition(": ")[2]}
            continue
        held = evaluate_association(mine._replace(rows=rows), {})
        yield row | {"held %": 100 - 100 * held["pl_exceeded"], "PL median m": rows["pl_m"].median(), "refused": ""}


def _tracked(walk: RecordingFolder, on: Iterable[RecordingFolder]) -> Association:
    """The estimates of a walk, calibrated on others, with its truth."""
    folder = walk.calibrated(calibrate([*on]))
    return associate(build("bearings", folder).run(folder), folder)
