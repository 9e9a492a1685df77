"""Sentences on whether reported covariances hold: from the errors, or from the innovations where there is no truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from trackwright.trackers.core.errors import counted, listed, significant

LEAST_SAMPLES, LOST = 8.0, 0.1
"""Effective samples below which a recording is too short for a verdict; the share of rows that are lost or have no
covariance beyond which covariances are not judged."""

HOLD, SHORT, SMALL, LARGE = "hold", "too short", "too small", "too large"


def verdict(metrics: Mapping[str, Any], name: str = "nees") -> str | None:
    """Whether `nees`, `nees_3d` or `nis` is in its band, whether the recording is too short for that, or what is wrong.

    None where it is unknown: without covariances, or where more than `LOST` of the rows have none.
    """
    ratio, end = metrics.get(f"{name}_ratio"), name.removeprefix("nees")
    if ratio is None or (name != "nis" and max(_unknown(metrics, x) for x in ("", end)) > LOST):
        return None
    if metrics[f"n_effective_{name}".replace("_nees", "")] < LEAST_SAMPLES:
        return SHORT
    return SMALL if ratio > metrics[f"{name}_high"] else LARGE if ratio < metrics[f"{name}_low"] else HOLD


def covariance_statements(overall: Mapping[str, Any], recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the metrics of all rows, and on the recordings whose covariances do not hold; losses come first.

    Nothing on covariances where tracks are lost in more than `LOST` of the rows; without any, on the innovations.
    """
    sentences, losses = list[str](), overall["losses"]
    if losses:
        suitable = "With a suitable model a track is lost only where readings are missing."
        sentences.append(
            f"Tracks were lost {counted(losses, 'time')}, for {overall['lost_s']:.3g} s in all. {suitable}"
        )
    if losses and max(losses / overall["n_rows"], overall["lost_fraction"]) > LOST:
        return sentences
    if overall["coverage_95"] is None:
        return sentences + _sentence(overall, "nis")
    sentences += _sentence(overall, "nees")
    wrong = [f"{r['recording']} ({_factor(r, 'nees')} {v})" for r in recordings if (v := verdict(r)) in (SMALL, LARGE)]
    if wrong and len(recordings) > 1:
        sentences.append(f"Outside their band: {len(wrong)} of {len(recordings)} recordings, {listed(wrong)}.")
    if verdict(overall, "nees_3d") in (SMALL, LARGE):
        sentences += _sentence(overall, "nees_3d")
    end = "" if _unknown(overall, "") else "_3d"
    if unknown := _unknown(overall, end):
        none, zero = (overall[f"n_{what}_covariance{end}"] for what in ("no", "zero"))
        rows = f"{none} of {overall['n']} rows are without a covariance{' in three dimensions' if end else ''}"
        judged = "; with more than a tenth, covariances are not judged" if unknown > LOST else ""
        sentences.append(f"{rows}, {zero} of them with a zero or singular one, which has no truth inside{judged}.")
    return sentences


def _unknown(metrics: Mapping[str, Any], end: str) -> float:
    """The share of rows without a covariance, or with one of zero."""
    return (metrics.get(f"n_no_covariance{end}") or 0) / (metrics.get("n") or 1)


def _factor(metrics: Mapping[str, Any], name: str) -> str:
    """How many times standard deviations are too small or too large, the root of NEES or NIS per degree of freedom."""
    root = math.sqrt(metrics[f"{name}_ratio"])
    times = max(root, 1 / root) if root else math.inf  # errors of a copy are zero
    return f"{significant(times, 2 if times >= 1.1 else 4)} times"


def _sentence(metrics: Mapping[str, Any], name: str) -> list[str]:
    """The verdict on NEES or NIS with its band, its effective samples and the regret; none without a verdict."""
    found = verdict(metrics, name)
    if found is None:
        return []
    what = "Standard deviations of the innovations" if name == "nis" else "Reported standard deviations"
    what += " in three dimensions" * (name == "nees_3d")
    words = {HOLD: "as those of a perfect filter", SHORT: f"not judged, the recording is {SHORT}"}
    ratio, low, high = (significant(metrics[f"{name}_{x}"], 3) for x in ("ratio", "low", "high"))
    lost = metrics.get(f"regret{name.removeprefix('nees')}")
    samples = significant(metrics[f"n_effective_{name}".replace("_nees", "")], 3)
    figures = f"band {low} to {high} ({samples} effective samples)"
    figures += "" if lost is None else f", regret {significant(lost, 2)} nats"
    judged = words.get(found) or f"{_factor(metrics, name)} {found}"
    return [f"{what} are {judged}: {name[:4].strip('_').upper()}/dof {ratio}, {figures}."]
