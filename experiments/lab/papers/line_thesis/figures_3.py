"""Figures 3.1-3.6 of the thesis: one recording of each situation, the filters' positions and their errors over time.

Figures 3.1, 3.3 and 3.5 show the path with the outputs of both filters, 3.2, 3.4 and 3.6 the errors over time with
their averages, of set 1 of each situation. Their captions print two numbers each, the measurement error and the
improvement of the particle filter over the Kalman filter. Both follow from Table 3.1 (`table_3_1`) and are not judged
again. A printed number belongs to one recording, ours is the mean over many.

The worlds `… run again` repeat one recording for particles with other random numbers: the thesis averages ten such
runs, because a single one "does not necessarily provide a representative output".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import polars as pl

import trackwright.experiments.monte_carlo as mc
from trackwright.experiments.lab.papers.fitting import fitted
from trackwright.experiments.lab.papers.line_thesis import _assembly_line as line
from trackwright.experiments.monte_carlo.chunk import tracked_runs
from trackwright.experiments.pages.charts.style import BLUE, GREY, VERMILION
from trackwright.trackers.recordings.folder import RecordingFolder

PRINTED = {"situation 1": (31.1, 8.1), "situation 2": (30.3, 9.6), "situation 3": (38.7, 11.3)}
"""Measurement error and improvement, cm: captions of Figures 3.2, 3.4 and 3.6."""

FIRST = {situation: f"{situation}, set 1" for situation in line.SITUATIONS}
NUMBERS = fitted("papers/line_thesis/table_3_1")
COLOURS = {"raw": GREY, "Kalman": BLUE, "particle": VERMILION}


def over_and_over(ids: np.ndarray, seed: int, **numbers: float) -> RecordingFolder:
    """The first draw of a recording, repeated under the names of all ids."""
    draw = line.recording(np.array([0]), seed, **numbers)  # type: ignore[arg-type]
    tags = pl.DataFrame({"tag": [str(i) for i in ids]})
    tables = {
        name: table.drop("tag").join(tags, how="cross").select(table.columns).sort("t_s", maintain_order=True)
        for name, table in draw.tables.items()
    }
    rig = dataclasses.replace(draw.rig, tags={str(i): draw.rig.tags["0"] for i in ids})
    return dataclasses.replace(draw, rig=rig, tables=tables)


def off_path(tracked: mc.TrackedRuns) -> np.ndarray:
    """Mean distance (n,), m, of the estimates from the path, extended beyond its last knot as in (2.5)."""
    path = line.open_ended(tracked.folder.rig.path_knots)
    distance = path.nearest(np.nan_to_num(tracked.estimates[..., :2]))[1]
    return np.asarray(np.nanmean(np.where(tracked.known, distance, np.nan), axis=1))


def expected(results: mc.Results) -> Iterator[mc.Claim]:
    """The captions' numbers, and the conclusions of chapter 3."""
    shares = []
    for number, (situation, (measured, better)) in enumerate(PRINTED.items()):
        world, figure = FIRST[situation], f"Figure 3.{2 * number + 2}"
        yield mc.ExpectedResult(
            f"{figure}, average measurement error",
            measured,
            results.value("error_m", world, "raw").times(100),
            "cm",
            mc.DERIVED,
            note="printed in Table 3.1, too",
        )
        gain = results.difference("error_m", world, "Kalman", "particle").times(100)
        gains = 100 * (results.numbers("error_m", world, "Kalman") - results.numbers("error_m", world, "particle"))
        note = (
            f"follows from Table 3.1; one recording scatters by ± {gains.std(ddof=1):.1f} cm, and the printed one lies "
            f"{(better - gain.value) / gains.std(ddof=1):+.1f} of that away"
        )
        quantity = f"{figure}, improvement of the particle filter"
        yield mc.ExpectedResult(quantity, better, gain, "cm", mc.DERIVED, note=note)
        runs = tracked_runs(results.study, world, np.arange(results.study.chunk))
        below = line.distances(runs["particle"]) < line.distances(runs["Kalman"])
        shares.append(float(below[runs["particle"].known].mean()))
    particle, kalman = (
        max(results.value("off_path_m", world, tracker).value for world in FIRST.values())
        for tracker in ("particle", "Kalman")
    )
    scatter, spread = (
        [100 * results.numbers("error_m", f"{world}{again}", "particle").std(ddof=1) for world in FIRST.values()]
        for again in (", run again", "")
    )
    yield mc.Conclusion(
        "the particle filter's output always stays on the assembly line, the Kalman filter strays away",
        particle < 1e-3 < kalman,
        f"{100 * particle:.2f} and up to {100 * kalman:.1f} cm from the path on average",
        mc.DERIVED,
    )
    yield mc.Conclusion(
        "the particle filter's error is below the Kalman filter's for a large part of the time",
        min(shares) > 0.6,
        "of the time: " + ", ".join(f"{100 * s:.0f} %" for s in shares),
        mc.DERIVED,
    )
    yield mc.Conclusion(
        "a single trial is not representative: other random numbers give other errors",
        min(scatter) > 0,
        f"runs on one recording scatter by ± {min(scatter):.1f} to {max(scatter):.1f} cm, recordings by "
        f"± {min(spread):.1f} to {max(spread):.1f} cm: ten runs average the lesser of the two",
        mc.PREDICTED,
    )


_MANY = line.worlds(NUMBERS, tuple(FIRST.values()))
STUDY = mc.Study(
    name="figures-3",
    about="How do both filters' errors run over one recording of each situation, and which is the better, when?",
    worlds=_MANY | {f"{name}, run again": mc.World(over_and_over, world.numbers) for name, world in _MANY.items()},
    trackers={
        "particle": line.with_noise(line.PARTICLE, NUMBERS["sigma_particle"]),
        "Kalman": line.with_noise(line.KALMAN, NUMBERS["sigma_kalman"]),
        "raw": line.RAW,
    },
    runs=40,
    measures={"error_m": line.error, "off_path_m": off_path},
    metrics=("mean_m", "rmse_m", "p95_m"),
    expected=expected,
)
