"""Sentences on whether reported covariances hold: from the errors, or from the innovations where there is no truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import significant

COVERAGE = (0.88, 0.99)
"""The share of the truth inside the 95 % ellipse with which covariances hold."""

RATIO = (0.67, 1.4)
"""NEES per degree of freedom with which covariances hold, and NIS per degree of freedom that is as expected.

Standard deviations are then at most a fifth too small or too large, where the 95 % ellipse holds 88 to 99 % of normal
errors. Worlds of a tracker's own model have a NIS within
(`python -m trackwright.experiments.lab nis`).
"""

LIMITS = f"limits {100 * COVERAGE[0]:.0f} to {100 * COVERAGE[1]:.0f} %", f"limits {RATIO[0]:g} to {RATIO[1]:g}"
"""The limits of the share and of the ratio, in words."""

FACTOR = 1.15
"""The factor on standard deviations from which on they are too small or too large as a whole."""

MOST = 1000
"""The largest factor that is named; errors of zero have none."""

CORRELATION = 0.2
"""The autocorrelation of NIS over 1 s from which on innovations count as correlated."""

INFLATION = 10.0
"""Rows with the information of one from which on innovations count as correlated, however small the autocorrelation.

With many readings a second, of several sensors in turn, neighbouring rows are hardly correlated and whole seconds are.
On the recordings used for development, covariances are too small on all above this value.
"""

LOST = 0.1
"""The share of rows in which tracks are lost, start again or have no covariance, beyond which these are not judged."""

LASTING = 1.4
"""The ratio of `residual_ratio_5s` from which on residuals of some stations or anchors last.

Between walks whose covariances hold and one whose do not (ble51-walk-u1-r1 and u2-r1, 1.1 at most, and u3-r1, 1.6).
"""


def covariance_statements(overall: Mapping[str, Any], recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences on the metrics of all rows, and on the recordings whose covariances do not hold; losses come first.

    Covariances hold with a share of `COVERAGE` in the 95 % ellipse and NEES per degree of freedom within `RATIO`. The
    factor by which they are too small is the metric `sigma_factor`. Nothing without a covariance, nor where tracks are
    lost in more than `LOST` of the rows.
    """
    losses = _losses(overall)
    if losses and max(overall["losses"] / overall["n_rows"], overall["lost_fraction"]) > LOST:
        return losses
    if overall["coverage_95"] is None:
        return losses + _innovations(overall, recordings)
    bad = [f"{r['recording']} ({_percent(r['coverage_95'])})" for r in recordings if not holds(r)]
    gaps = _gaps(overall, "") or _gaps(overall, "_3d")
    several = f"do not hold in {len(bad)} of {len(recordings)} recordings: {listed(bad)}."
    if _unknown(overall, "") > LOST:
        sentences = losses
    elif len(recordings) > 1 and bad and holds(overall):
        # Too large ones and too small ones have a good mean.
        sentences = [*losses, f"Reported covariances {several} In all rows {_figures(overall, '')}."]
    else:
        sentences = [*losses, f"Reported {_covariance(overall, '')}."]
        sentences += [f"They {several}"] if len(recordings) > 1 and bad else []
    if overall.get("coverage_95_3d") is not None and not holds(overall, "_3d"):
        sentences.append(f"In three dimensions, reported {_covariance(overall, '_3d')}.")
    sentences = [*sentences, *gaps, *_lasting(recordings)]
    if any(correlated(r) for r in recordings):
        sentences.append(f"NIS is correlated {_correlation(recordings)}: errors last longer than the model assumes.")
    return sentences


def holds(metrics: Mapping[str, Any], suffix: str = "") -> bool:
    """Whether the reported covariances hold, or are unknown; `suffix`: _3d for those in three dimensions."""
    if metrics[f"coverage_95{suffix}"] is None or max(_unknown(metrics, x) for x in ("", suffix)) > LOST:
        return True
    share, ratio = _as_printed(metrics, suffix)
    return COVERAGE[0] <= share <= COVERAGE[1] and RATIO[0] <= ratio <= RATIO[1]


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


def correlated(metrics: Mapping[str, Any]) -> bool:
    """Whether the innovations are correlated over time."""
    correlation, inflation = metrics["nis_correlation_1s"], metrics["nis_inflation_1s"]
    return (correlation is not None and correlation > CORRELATION) or (inflation is not None and inflation > INFLATION)


def _covariance(metrics: Mapping[str, Any], suffix: str) -> str:
    """The size of the standard deviations relative to the errors, and the figures that show it."""
    (share, ratio), factor = _as_printed(metrics, suffix), metrics[f"sigma_factor{suffix}"]
    figures = _figures(metrics, suffix)
    if holds(metrics, suffix):
        return f"covariances hold: {figures}"
    small = share < COVERAGE[0] or ratio > RATIO[1]
    if small and factor >= FACTOR:
        return f"standard deviations are {significant(factor, 2)} times too small: {figures}"
    if not small and factor <= 1 / FACTOR:
        # Errors may be zero: of a trajectory that is compared with itself, or aligned with a copy.
        times = significant(1 / factor, 2) if factor > 1 / MOST else f"over {MOST}"
        where = " for the median error and fit large ones" if share <= COVERAGE[1] else ""
        return f"standard deviations are {times} times too large{where}: {figures}"
    large = "too small for large errors" if small else "too large for large errors"
    return f"standard deviations fit the median error and are {large}: {figures}"


def _figures(metrics: Mapping[str, Any], suffix: str) -> str:
    """The share of the truth inside and NEES per degree of freedom, with their limits."""
    shape, share = "ellipsoid" if suffix else "ellipse", metrics[f"coverage_95{suffix}"]
    return (
        f"the 95 % {shape} holds the truth in {_percent(share)} of the rows ({LIMITS[0]}), "
        f"NEES/dof is {significant(metrics[f'nees{suffix}_ratio'], 3)} ({LIMITS[1]})"
    )


def _as_printed(metrics: Mapping[str, Any], suffix: str) -> tuple[float, float]:
    """The share in the 95 % ellipse and NEES per degree of freedom, rounded as in the sentences with the limits."""
    share = metrics[f"coverage_95{suffix}"]
    return round(share, 2 if share <= 0.99 else 3), float(f"{metrics[f'nees{suffix}_ratio']:.3g}")


def _innovations(overall: Mapping[str, Any], recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The sentence on the innovations alone; none for a tracker without."""
    ratio = overall["nis_ratio"]
    if ratio is None:
        return []
    if lasting := _lasting(recordings):
        return lasting
    if any(correlated(r) for r in recordings):
        where = _correlation(recordings)
        return [f"Innovations are correlated {where}: the reported covariances are too small by an unknown factor."]
    figures = f"NIS/dof {significant(ratio, 2)}, 1 expected, {LIMITS[1]}"
    if ratio > RATIO[1]:
        return [f"The readings scatter more than the tracker's model expects ({figures}): covariances are too small."]
    if ratio < RATIO[0]:
        return [
            f"The readings scatter less than the tracker's model expects ({figures}); whether the reported covariances "
            "hold shows only against truth."
        ]
    if overall["losses"]:
        return []  # what rows between losses look like is no comfort
    return [
        f"The innovations are as the tracker's model expects ({figures}; uncorrelated over 1 s); constant errors do "
        "not show in them."
    ]


def _losses(overall: Mapping[str, Any]) -> list[str]:
    """The sentence on the losses of tracks; none where there are none."""
    losses = overall["losses"]
    if not losses:
        return []
    times = "once" if losses == 1 else f"{losses} times"
    stayed = f", for {overall['lost_s']:.3g} s in all" if overall["lost_s"] > 0 else ""
    suitable = "With a suitable model a track is lost only where readings are missing."
    return [f"Tracks were lost {times}{stayed}. {suitable}"]


def _lasting(recordings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The sentence on residuals that last, with the largest ratio; none where they do not."""
    lasting = [r for r in recordings if (r.get("residual_ratio_5s") or 0.0) >= LASTING]
    if not lasting:
        return []
    of = f" of {listed([r['recording'] for r in lasting])}" if len(recordings) > 1 else ""
    largest = max(r["residual_ratio_5s"] for r in lasting)
    return [
        f"Residuals of some stations or anchors{of} last: averaged over 5 s, they are {significant(largest, 2)} times "
        "the size of a typical residual. The reported covariances do not allow for that."
    ]


def _correlation(recordings: Sequence[Mapping[str, Any]]) -> str:
    """The autocorrelation and inflation of the recording with the most, and the names of all that are correlated."""
    affected = [r for r in recordings if correlated(r)]
    worst = max(affected, key=lambda r: r["nis_inflation_1s"] or 0.0)
    of = f" of {listed([r['recording'] for r in affected])}" if len(recordings) > 1 else ""
    r, n = worst["nis_correlation_1s"], worst["nis_inflation_1s"]
    # Errors that last for less than a second show in the means of a second, and not at that lag.
    over = r is not None and r > CORRELATION
    correlation = f"{r:.2f}" if over else ""
    when = "over" if over else "within"
    # Of short recordings the estimate may be below one.
    more = n is not None and float(f"{n:.2g}") > 1
    carried = f"{significant(n, 2)} rows carry the information of one" if more else ""
    return f"{when} 1 s{of} ({'; '.join(filter(None, (correlation, carried)))})"


def _percent(share: float) -> str:
    """A share in per cent; 0 and 100 only where it is exactly that."""
    percent = 100 * share
    if percent in (0.0, 100.0) or 1 <= percent <= 99:
        return f"{percent:.0f} %"
    return f"{min(max(percent, 0.1), 99.9):.1f} %"
