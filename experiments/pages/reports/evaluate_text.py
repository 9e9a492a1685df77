"""What `evaluate` prints beside the error metrics: absolute and relative pose errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from trackwright.experiments.text.tables import compact_table, rendered
from trackwright.experiments.text.wording import fixed, length_unit
from trackwright.trackers.exchange.estimates import ComparedTrack
from trackwright.trackers.exchange.pose_errors import Statistics, TrajectoryErrors

SHOWN_TRACKS = 10
"""The most tracks listed: those with the largest APE."""

_STATISTICS = ("rmse", "mean", "median", "std", "min", "max")


def pose_errors_text(compared: Sequence[ComparedTrack], align: str, width: int, fitted_offset: bool = False) -> str:
    """The errors of each track, a row for each kind of error, and what was done to the estimates before.

    `fitted_offset`: whether the time offset is the one that fits best.
    """
    worst = sorted(compared, key=lambda track: -track.errors.ape_m["rmse"])[:SHOWN_TRACKS]
    unit = length_unit(worst[0].errors.ape_m["rmse"])
    table = compact_table("Absolute and relative pose errors", ["tag", "error"], ["unit", "n", *_STATISTICS])
    for track in worst:
        for label, name, factor, of in _rows(track.errors, unit.name, unit.factor):
            digits = unit.digits + 1 if name == unit.name else 3
            table.add_row(track.tag, label, name, str(of["n"]), *(fixed(of[k] * factor, digits) for k in _STATISTICS))
    errors = [track.errors for track in compared]
    offsets, scales = sorted({round(e.time_offset, 4) for e in errors}), [e.similarity.scale for e in errors]
    offset = " to ".join(f"{x:.12g}" for x in dict.fromkeys((offsets[0], offsets[-1])))
    scale = " to ".join(dict.fromkeys((f"{min(scales):.6g}", f"{max(scales):.6g}")))
    scale = "" if scale == "1" else f", scale {scale}"
    biases = [e.speed_mps["bias"] for e in errors if e.speed_mps is not None]
    notes = {
        f"As evo: {sum(e.pairs for e in errors)} of {sum(e.possible for e in errors)} poses have a true pose within "
        f"{errors[0].tolerance:g} s; time offset {offset} s; alignment {align}{scale}.": True,
        "The errors in the first table are of all rows, at the time of each, by the truth interpolated there.": True,
        "The fitted time offset holds the delay of a filter, too; only a smoothed track (`track --smooth`) shows the "
        "clocks' alone.": fitted_offset,
        "APE and RPE are horizontal: a height is unknown.": any(e.planar for e in errors),
        f"Speed: horizontal, over 0.5 s; mean error {sum(biases) / max(len(biases), 1):+.4f} m/s.": bool(biases),
        f"At most {SHOWN_TRACKS} tracks are listed, those with the largest APE.": len(compared) > SHOWN_TRACKS,
    }
    return rendered(width, table, *(note for note, holds in notes.items() if holds))


def _rows(errors: TrajectoryErrors, unit: str, factor: float) -> Iterator[tuple[str, str, float, Statistics]]:
    """Of each error: its name, its unit, the factor to it, and its statistics."""
    yield "APE", unit, factor, errors.ape_m
    if errors.ape_rad is not None:
        yield "APE, angle", "deg", 180 / math.pi, errors.ape_rad
    for step, statistics in errors.rpe_m.items():
        yield f"RPE {step}", unit, factor, statistics
        if step in errors.rpe_rad:
            yield f"RPE {step}, angle", "deg", 180 / math.pi, errors.rpe_rad[step]
    if errors.speed_mps is not None:
        yield "speed", "m/s", 1.0, errors.speed_mps
