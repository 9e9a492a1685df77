"""Values fitted to one to five recordings of a site with default options, judged on another that no fit has seen.

The mean log density of the true position less that at the defaults, nats, with its 95 % interval, and the RMSE.
"""

from collections.abc import Iterator
from functools import partial
from typing import get_args

import trackwright as tw
from trackwright.experiments.lab.runner import Case, Figures
from trackwright.experiments.lab.validation.sites import read, recordings
from trackwright.experiments.pages.reports.before_after import judge, tracked
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.tuning.parameters import PriorKind

SITES = {
    "ble51-walk-*": "bearings", "starloc-*": "uwb", "rcv-drone-*": "uwb", "iasl-drone-*": "uwb", "tiers-*": "fix-kf",
    "ngbui-line-1-*": "line-grid", "ngbui-line-2-*": "line-grid", "ngbui-line-3-*": "line-grid", "util-c1-*": "tdoa",
}  # fmt: skip
"""Recordings of one site each, and their tracker by default."""

COUNTS = (1, 2, 3, 5)


def cases() -> Iterator[Case]:
    """Each recording of each site, with the values of those that follow it by name, the first after the last."""
    for pattern, tracker in SITES.items():
        names = recordings(pattern)
        for count in (n for n in COUNTS if n < len(names)):
            for k, name in enumerate(names):
                fitted_to = (*names[k + 1 :], *names[:k])[:count]
                for prior in get_args(PriorKind):
                    measure = partial(figures, tracker, name, fitted_to, prior)
                    yield Case(name, tracker, f"{prior}, fitted to {', '.join(fitted_to)}", measure)


def figures(tracker: str, name: str, fitted_to: tuple[str, ...], prior: PriorKind) -> Figures:
    """The log density and the errors of a recording, after and before."""
    folder, others = read(name), [read(other) for other in fitted_to]
    named = tw.build(tracker, [*others, folder])
    fitted = tw.fit(named, others, options=tw.FitOptions(prior=prior)).tracker
    sides = tracked(named, [folder]), tracked(fitted, [folder])
    change = judge(sides, 2).recordings[name]
    default, rmse = (Evaluation.of(side)["rmse_m"] for side in sides)
    gain = {"gain_nats": change.value, "low": change.low, "high": change.high}
    return {"recordings": len(others), "log_density": change.second, **gain, "rmse_m": rmse, "rmse_default_m": default}
