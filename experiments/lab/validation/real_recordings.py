"""Errors and covariances on real recordings: default levels, levels of other sites, calibrated, tuned, smoothed.

No recording is judged on a calibration, tuning or levels that have seen it. It is calibrated on the other recordings of
its site with the same installation; where there is none, each half of it, in time, on the other half.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache, partial
from typing import get_args

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation import levels
from trackwright.experiments.lab.validation.sites import SITES, Site, read, recordings, same_installation, site_of
from trackwright.experiments.pages.tuning import judge, tracked
from trackwright.trackers.evaluation.evaluate import Evaluation, verdict
from trackwright.tuning.calibrating import by_halves
from trackwright.tuning.parameters import PriorKind

SMOOTHED, OTHER_SITES, LATENCY = " smoothed", "other sites", "*latency*"
NEVER_SMOOTHED = ("line-grid", "das", "trilateration-compensated")
CALIBRATED = ("bearings", "uwb", "line-grid")


def cases() -> Iterator[Case]:
    """Every recording of every site by every tracker in every setting."""
    for site in SITES:
        for name in recordings(site.pattern):
            for tracker in site.trackers:
                for setting in settings(site, name, tracker):
                    yield Case(name, tracker, setting, partial(figures, name, tracker, setting))


def settings(site: Site, name: str, tracker: str) -> Iterator[str]:
    """The settings of a tracker on a recording; the first tracker of a site alone runs at levels of other sites."""
    of = {
        "defaults": True,
        OTHER_SITES: not site.still and tracker == site.trackers[0] and levels.set_by(tracker, name),
        "calibrated": tracker in CALIBRATED,
        "tuned": tracker == "fix-mirror",
    }
    for setting in (name for name, applies in of.items() if applies):
        yield setting
        if tracker not in NEVER_SMOOTHED and not site.still:
            yield setting + SMOOTHED


def figures(name: str, tracker: str, setting: str) -> Figures:
    """The errors and covariances of a recording; `on`: what it was calibrated or tuned on."""
    base, smoothed, _ = setting.partition(SMOOTHED)
    parts, named, on = prepared(name, tracker, base)
    metrics = tw.evaluate((named.smoothing() if smoothed else named).run(parts), parts).overall
    return {
        "rmse_m": metrics.get("rmse_m"),
        "rmse_3d_m": None if metrics.get("coverage_95_3d") is None else metrics["rmse_3d_m"],
        "rmse_direction_rad": metrics.get("rmse_direction_rad"),
        "nees_per_dof": metrics.get("nees_ratio"),
        "inside_95": metrics.get("coverage_95"),
        "regret_nats": metrics.get("regret"),
        "n_effective": metrics.get("n_effective"),
        "log_density_nats": metrics.get("log_density"),
        "energy_score_m": metrics.get("energy_score_m"),
        "covariances": verdict(metrics),
        "on": on,
    }


@lru_cache(maxsize=2)
def prepared(name: str, tracker: str, setting: str) -> tuple[list[tw.RecordingFolder], tw.NamedTracker, str]:
    """The recording as it is run, the tracker, and what this was set on."""
    folder = read(name)
    site = site_of(name)
    others = [read(other) for other in (*recordings(site.pattern), *recordings(site.others)) if other != name]
    if setting == "defaults":
        return [folder], tw.build(tracker, folder), ""
    if setting == OTHER_SITES:
        return [folder], levels.at(tw.build(tracker, folder), levels.left_out(tracker, name)), "levels.csv"
    if setting == "tuned":
        fitted = tw.fit(tw.build(tracker, others), others, "rmse", (LATENCY,), tw.FitOptions(dimensions=3))
        named = tw.build(tracker, folder).with_values(dict(fitted.tracker.values), "the fit")
        return [folder], named, f"{len(others)} others"
    same = [other for other in others if same_installation(folder, other)]
    parts = [folder.calibrated(tw.calibrate(same))] if same else by_halves(folder)
    return parts, tw.build(tracker, parts), f"{len(same)} others" if same else "the other half"


PLACES = {
    "ble51-walk-*": "bearings", "starloc-*": "uwb", "rcv-drone-*": "uwb", "iasl-drone-*": "uwb", "tiers-*": "fix-kf",
    "ngbui-line-1-*": "line-grid", "ngbui-line-2-*": "line-grid", "ngbui-line-3-*": "line-grid", "util-c1-*": "tdoa",
}  # fmt: skip
"""Recordings of one site each, and their tracker by default."""

COUNTS = (1, 2, 3, 5)


def generalisation_cases() -> Iterator[Case]:
    """Values fitted to one to five recordings of a site, judged on another: by name the one after, in a circle."""
    for pattern, tracker in PLACES.items():
        names = recordings(pattern)
        for count in (n for n in COUNTS if n < len(names)):
            for k, name in enumerate(names):
                fitted_to = (*names[k + 1 :], *names[:k])[:count]
                for prior in get_args(PriorKind):
                    measure = partial(generalisation, tracker, name, fitted_to, prior)
                    yield Case(name, tracker, f"{prior}, fitted to {', '.join(fitted_to)}", measure)


def generalisation(tracker: str, name: str, fitted_to: tuple[str, ...], prior: PriorKind) -> Figures:
    """The log density and the errors of a recording, after and before."""
    folder, others = read(name), [read(other) for other in fitted_to]
    named = tw.build(tracker, [*others, folder])
    fitted = tw.fit(named, others, options=tw.FitOptions(prior=prior)).tracker
    sides = tracked(named, [folder]), tracked(fitted, [folder])
    change = judge(sides, 2).recordings[name]
    default, rmse = (Evaluation.of(side)["rmse_m"] for side in sides)
    gain = {"gain_nats": change.value, "low": change.low, "high": change.high}
    return {"recordings": len(others), "log_density": change.second, **gain, "rmse_m": rmse, "rmse_default_m": default}
