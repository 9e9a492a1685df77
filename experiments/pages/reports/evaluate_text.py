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
_DEGREES = 180 / math.pi


def pose_errors_text(compared: Sequence[ComparedTrack], align: str, width: int, fitted_offset: bool = False) -> str:
    """The errors of each track, a row for each kind of error, and what was done to the estimates before.

    `fitted_offset`: whether the time offset is the one that fits best.
    """
    worst = sorted(compared, key=lambda track: -track.errors.ape_m["rmse"])[:SHOWN_TRACKS]
    several = len(compared) > 1
    unit = length_unit(worst[0].errors.ape_m["rmse"])
    table = compact_table(
        "Absolute and relative pose errors", ["tag", "error"] if several else ["error"], ["unit", "n", *_STATISTICS]
    )
    for track in worst:
        for k, (label, name, factor, errors) in enumerate(_rows(track.errors, unit.name, unit.factor)):
            shown = unit.digits + 1 if name == unit.name else 3
            cells = [fixed(errors[key] * factor, shown) for key in _STATISTICS]
            head = [track.tag if k == 0 else "", label] if several else [label]
            table.add_row(*head, name, str(errors["n"]), *cells)
    return rendered(width, table, *_pose_notes(compared, align, fitted_offset))


def _rows(errors: TrajectoryErrors, unit: str, factor: float) -> Iterator[tuple[str, str, float, Statistics]]:
    """Of each error: its name, its unit, the factor to it, and its statistics."""
    yield "APE", unit, factor, errors.ape_m
    if errors.ape_rad is not None:
        yield "APE, angle", "deg", _DEGREES, errors.ape_rad
    for step, statistics in errors.rpe_m.items():
        yield f"RPE {step}", unit, factor, statistics
        if step in errors.rpe_rad:
            yield f"RPE {step}, angle", "deg", _DEGREES, errors.rpe_rad[step]
    if errors.speed_mps is not None:
        yield "speed", "m/s", 1.0, errors.speed_mps


def _pose_notes(compared: Sequence[ComparedTrack], align: str, fitted_offset: bool) -> list[str]:
    errors = [track.errors for track in compared]
    pairs, possible = sum(e.pairs for e in errors), sum(e.possible for e in errors)
    offsets = sorted({round(e.time_offset, 4) for e in errors})
    offset = f"{offsets[0]:.12g}" if len(offsets) == 1 else f"{offsets[0]:.12g} to {offsets[-1]:.12g}"
    scales = [e.similarity.scale for e in errors]
    scale = "" if all(s == 1.0 for s in scales) else f", scale {min(scales):.6g} to {max(scales):.6g}"
    scale = f", scale {scales[0]:.6g}" if scale and len(scales) == 1 else scale
    notes = [
        f"As evo: {pairs} of {possible} poses have a true pose within {errors[0].tolerance:g} s; time offset {offset} "
        f"s; alignment {align}{scale}.",
        "The errors in the first table are of all rows, at the time of each, by the truth interpolated there.",
    ]
    if fitted_offset:
        notes.append(
            "The time offset is the one that fits best: a delay of the estimates, as a filter has, is part of it and "
            "does not count as error. The offset of the clocks alone is that of a smoothed track (`track --smooth`)."
        )
    if any(e.planar for e in errors):
        notes.append("APE and RPE are horizontal: a height is unknown.")
    if any(e.speed_mps is not None for e in errors):
        biases = [e.speed_mps["bias"] for e in errors if e.speed_mps is not None]
        notes.append(f"Speed: horizontal, over 0.5 s; mean error {sum(biases) / len(biases):+.4f} m/s.")
    if len(compared) > SHOWN_TRACKS:
        notes.append(f"At most {SHOWN_TRACKS} tracks are listed, those with the largest APE.")
    return notes
