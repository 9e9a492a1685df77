"""Sentences on whether reported covariances hold: from the errors, or from the innovations where there is no truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant
from trackwright.trackers.evaluation.judge import LEAST_SAMPLES

MOST = 1000
"""The largest factor that is named; errors of zero have none."""

LOST = 0.1
"""The share of rows in which tracks are lost, start again or have no covariance, beyond which these are not judged."""

HOLD, SHORT, SMALL, LARGE = "hold", "too short", "too small", "too large"


def verdict(metrics: Mapping[str, Any], name: str = "nees") -> str | None:
    """Whether `nees`, `nees_3d` or `nis` is in its band, whether the recording is too short for that, or what is wrong.

    None where it is unknown: without covariances, or where more than `LOST` of the rows have none.
    """
    ratio, suffix = metrics.get(f"{name}_ratio"), name.removeprefix("nees")
    if ratio is None or (name != "nis" and max(_unknown(metrics, x) for x in ("", suffix)) > LOST):
        return None
    if metrics[_samples(name)] < LEAST_SAMPLES:
        return SHORT
    return SMALL if ratio > metrics[f"{name}_high"] else LARGE if ratio < metrics[f"{name}_low"] else HOLD


def _samples(name: str) -> str:
    return {"nees": "n_effective", "nees_3d": "n_effective_3d", "nis": "n_effective_nis"}[name]


def covariance_statements(overall: Mapping[str, Any], recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the metrics of all rows, and on the recordings whose covariances do not hold; losses come first.

    Standard deviations are too small or too large where NEES lies outside the band of a perfect filter. Nothing without
    a covariance, nor where tracks are lost in more than `LOST` of the rows.
    """
    losses = _losses(overall)
    if losses and max(overall["losses"] / overall["n_rows"], overall["lost_fraction"]) > LOST:
        return losses
    if overall["coverage_95"] is None:
        return losses + _innovations(overall)
    sentences = [*losses, *_covariance(overall, "nees")]
    wrong = [f"{r['recording']} ({_factor(r)} {found})" for r in recordings if (found := verdict(r)) in (SMALL, LARGE)]
    if sentences[len(losses) :] and len(recordings) > 1 and wrong:
        sentences.append(f"Outside their band: {len(wrong)} of {len(recordings)} recordings, {listed(wrong)}.")
    if verdict(overall, "nees_3d") in (SMALL, LARGE):
        sentences += [f"In three dimensions, r{x[1:]}" for x in _covariance(overall, "nees_3d")]
    return [*sentences, *(_gaps(overall, "") or _gaps(overall, "_3d"))]


def _unknown(metrics: Mapping[str, Any], suffix: str) -> float:
    """The share of rows without a covariance, or with one of zero."""
    return (metrics.get(f"n_no_covariance{suffix}") or 0) / (metrics.get("n") or 1)


def _gaps(metrics: Mapping[str, Any], suffix: str) -> list[str]:
    """The sentence on rows without a covariance; none where all have one."""
    none, zero = (metrics.get(f"n_{what}_covariance{suffix}") for what in ("no", "zero"))
    space = " in three dimensions" if suffix else ""
    judged = "; with more than a tenth, covariances are not judged" if _unknown(metrics, suffix) > LOST else ""
    rows = f"{none} of {metrics['n']} rows are without a covariance{space}, {zero} of them with a zero or singular one"
    return [f"{rows}, which has no truth inside{judged}."] if none else []


def _covariance(metrics: Mapping[str, Any], name: str) -> list[str]:
    """The sentence on the standard deviations relative to the errors, with the figures that show it."""
    found = verdict(metrics, name)
    if found is None:
        return []
    figures = _figures(metrics, name)
    if found in (SMALL, LARGE):
        return [f"Reported standard deviations are {_factor(metrics, name)} {found}: {figures}."]
    if found == SHORT:
        return [f"{_short(metrics, name)} for a verdict on the reported covariances: {figures}."]
    return [f"Reported covariances are as those of a perfect filter: {figures}."]


def _factor(metrics: Mapping[str, Any], name: str = "nees") -> str:
    """How many times standard deviations are too small or too large, the root of NEES per degree of freedom."""
    root = math.sqrt(metrics[f"{name}_ratio"])
    # Errors may be zero: of a trajectory that is compared with itself, or aligned with a copy.
    if root <= 1 / MOST:
        return f"over {MOST} times"
    times = max(root, 1 / root)
    return f"{significant(times, 2 if times >= 1.1 else 4)} times"


def _short(metrics: Mapping[str, Any], name: str) -> str:
    samples = significant(metrics[_samples(name)], 2)
    return f"Too short, {samples} effective samples of at least {LEAST_SAMPLES:.0f},"


def _figures(metrics: Mapping[str, Any], name: str) -> str:
    """NEES or NIS per degree of freedom beside its band, and the regret of NEES."""
    ratio, low, high = (significant(metrics[f"{name}_{x}"], 3) for x in ("ratio", "low", "high"))
    samples, lost = significant(metrics[_samples(name)], 3), metrics.get(f"regret{name.removeprefix('nees')}")
    regret = "" if name == "nis" or lost is None else f", regret {significant(lost, 2)} nats"
    return f"{name[:4].rstrip('_').upper()}/dof {ratio}, band {low} to {high} ({samples} effective samples){regret}"


def _innovations(overall: Mapping[str, Any]) -> list[str]:
    """The sentence on the innovations alone; none for a tracker without."""
    found = verdict(overall, "nis")
    if found is None:
        return []
    figures = _figures(overall, "nis")
    if found == SMALL:
        why = "its noise is too small, or the model is biased"
        return [f"The readings scatter {_factor(overall, 'nis')} as much as the model expects, {why}: {figures}."]
    if found == LARGE:
        return [
            f"The readings scatter less than the tracker's model expects ({figures}); whether the reported covariances "
            "hold shows only against truth."
        ]
    if overall["losses"]:
        return []  # what rows between losses look like is no comfort
    if found == SHORT:
        return [f"{_short(overall, 'nis')} for a verdict on the innovations: {figures}."]
    return [f"The innovations are as the tracker's model expects ({figures}); constant errors do not show in them."]


def _losses(overall: Mapping[str, Any]) -> list[str]:
    """The sentence on the losses of tracks; none where there are none."""
    losses = overall["losses"]
    if not losses:
        return []
    times = "once" if losses == 1 else f"{losses} times"
    stayed = f", for {overall['lost_s']:.3g} s in all" if overall["lost_s"] > 0 else ""
    suitable = "With a suitable model a track is lost only where readings are missing."
    return [f"Tracks were lost {times}{stayed}. {suitable}"]
