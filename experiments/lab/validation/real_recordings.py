"""Accuracy and covariances on real recordings: every recording of every site (`sites.py`), with a verdict for each.

No recording is judged on a calibration or tuning that has seen it. Recordings are found by the names of their sites in
TRACKWRIGHT_RECORDINGS, default `../shared/recordings`; they are not part of this repository.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS as OUTPUT
from trackwright.experiments.lab.cases import LAB, Output, Row, Table, chosen, shown
from trackwright.experiments.lab.subprocesses import REPOSITORY, required_recordings
from trackwright.experiments.lab.validation.sites import (
    CALIBRATED,
    DEFAULTS,
    MARGIN,
    OTHER_HALF,
    OTHER_SITES,
    SITES,
    SMOOTHED_GOAL,
    Judged,
    Setting,
    Site,
    judged,
)
from trackwright.experiments.pages.charts.style import BLUE, GREY, VERMILION, write_panels
from trackwright.experiments.text.tables import replace_tables
from trackwright.experiments.text.wording import fixed
from trackwright.trackers.core.errors import UnusableInput

PAGE = REPOSITORY / "docs" / "real-recordings.md"
CURVES = PAGE.with_name("calibration-curves.png")
KINDS = [(setting, smoothed) for setting in (DEFAULTS, CALIBRATED) for smoothed in (False, True)]
"""Settings, filtered and smoothed, in the order of the tables and panels."""

SHOWN: dict[tuple[str, ...], str] = {OTHER_HALF: "on the other half", OTHER_SITES: "defaults of other sites"}
"""Settings by what a recording is calibrated, or the levels are found, on."""

LIMITED = (("RMSE", "rmse_m", False), ("3-D RMSE", "rmse_3d_m", False), ("RMSE", "rmse_m", True))
"""What each of `Errors` limits: in words, the metric, and whether that of smoothed estimates."""

LEVELS = (50, 68, 90, 95, 99)
"""Levels of ellipses, %, of the curves."""


def real_recordings(*, site: tuple[str, ...] = (), at_least: float | None = None, output: Output = OUTPUT) -> int:
    """Accuracy and covariances on every real recording against limits; 1 where one is missed.

    `--small`: of two sites. With `--page docs/real-recordings.md` also its picture and the summary in the README are
    written.

    Args:
        site: these sites alone.
        at_least: return 1 only where the share of recordings whose filtered covariances are within the limits of
            defaults, with levels that their sites have not set, is below this, as before a release.
    """
    keep_programs()
    best = baselines(required_recordings() / "README.md")
    quick = tuple(one.name for one in SITES if one.quick)
    names = chosen(site, (one.name for one in SITES), quick if output.small else ())
    every: list[Judged] = []
    for one in (result for place in SITES if place.name in names for result in judged(place)):
        shown([_row(one, best)])
        every.append(one)
    output.publish("validation real-recordings", *tables(every, best))
    if output.page is not None and output.page.resolve() == PAGE:
        plot_curves(CURVES, every)
        replace_tables(REPOSITORY / "README.md", f"{LAB}.validation real-recordings", quoted(every))
    missed = [check for check in checks(every) if not check.met]
    for check in missed:
        print(f"missed: {check}")
    if at_least is not None:
        held = _held(every, DEFAULTS, smoothed=False)
        if not held:
            raise UnusableInput(f"--at-least {at_least:g}: no recording of these sites counts; leave out --site")
        print(f"{sum(held)} of {len(held)} within limits, defaults, filtered; at least {at_least:g} of them required")
        return int(sum(held) < at_least * len(held))
    return int(bool(missed))


class Check(NamedTuple):
    """A figure, rounded as it is shown, and its lowest or highest value."""

    what: str
    figure: float
    lowest: float = float("-inf")
    highest: float = float("inf")

    @property
    def met(self) -> bool:
        """Whether the figure is within its limits."""
        return self.lowest <= self.figure <= self.highest

    def __str__(self) -> str:
        limit = f"≤ {self.highest:g}" if self.highest < float("inf") else f"≥ {self.lowest:g}"
        return f"{self.what} {self.figure:g}, limit {limit}"


def checks(every: Sequence[Judged]) -> list[Check]:
    """All limits: shares of recordings whose covariances are within limits, errors by site, and rooms."""
    shares = [
        Check(f"share of recordings within limits, {name},", round(sum(held) / len(held), 3), goal)
        for name, goal, held in _shares(every)
        if held
    ]
    rooms = [
        Check(f"{name}: m outside the room,", round(one.outside.distance, 2), highest=MARGIN)
        for name, one in _farthest(every).items()
    ]
    return [*shares, *_error_checks(every), *rooms]


def _shares(every: Sequence[Judged]) -> Iterator[tuple[str, float, list[bool]]]:
    """By setting and kind of estimates: its name, its goal, and whether each recording that counts is within limits."""
    for setting, smoothed in KINDS:
        goal = SMOOTHED_GOAL if smoothed else setting.goal
        yield _named(setting, smoothed), goal, _held(every, setting, smoothed)


def _held(every: Sequence[Judged], setting: Setting, smoothed: bool, counted: bool = True) -> list[bool]:
    """Whether each recording that counts, or each that does not, is within limits, of those with covariances."""
    of_kind = [one for one in every if (one.setting, one.smoothed, one.counted) == (setting, smoothed, counted)]
    return [one.holds for one in of_kind if one.holds is not None]


def _named(setting: Setting, smoothed: bool) -> str:
    return f"{setting.name}, {'smoothed' if smoothed else 'filtered'}"


def _error_checks(every: Sequence[Judged]) -> list[Check]:
    """The limits of the errors of each recording, or of their mean, and that smoothing does not add to them."""
    checks_of_errors = []
    for site, setting in dict.fromkeys((one.site, one.setting) for one in every):
        group = [one for one in every if (one.site, one.setting) == (site, setting)]
        counting = [one for one in group if one.on != OTHER_SITES and (setting == DEFAULTS or one.counted)]
        limits = site.defaults if setting == DEFAULTS else site.calibrated
        for limit, (what, metric, smoothed) in zip(limits, LIMITED, strict=True):
            if limit is None:
                continue
            figures = {one.recording: one.metrics[metric] for one in counting if one.smoothed == smoothed}
            if site.mean and figures:
                figures = {f"mean of {site.name}": float(np.mean(list(figures.values())))}
            about = f"{what}, {setting.name}{', smoothed' if smoothed else ''},"
            checks_of_errors += [
                Check(f"{name}: {about}", round(figure, 3), highest=limit) for name, figure in figures.items()
            ]
        rmse = {(one.recording, one.smoothed): round(one.metrics["rmse_m"], 3) for one in counting}
        checks_of_errors += [
            Check(f"{name}: RMSE, {setting.name}, smoothed,", rmse[name, True], highest=figure)
            for (name, smoothed), figure in rmse.items()
            if not smoothed and (name, True) in rmse
        ]
    return checks_of_errors


def tables(every: Sequence[Judged], best: Mapping[str, float]) -> list[Table]:
    """The tables of the page; `best`: the baselines, m, by recording."""
    limits = checks(every)
    verdict = f"**{sum(check.met for check in limits)} of {len(limits)} limits are met.**"
    sites = [
        Table([_row(one, best) for one in results], site.name[0].upper() + site.name[1:], _about(site, list(results)))
        for site, group in groupby(every, key=lambda one: one.site)
        for results in [list(group)]
    ]
    missed = [
        {"figure": check.what.rstrip(","), "m": f"{check.figure:g}", "limit": f"{check.highest:g}"}
        for check in _error_checks(every)
        if not check.met
    ]
    return [
        Table(_summary(every), "Recordings whose covariances are within limits", verdict),
        Table(missed, "Missed limits of errors"),
        *sites,
        Table(_rooms(every), "Rooms"),
    ]


def _summary(every: Sequence[Judged]) -> list[Row]:
    """How many recordings are within limits in each setting, those that do not count beside them."""
    rows = []
    for (name, goal, held), kind in zip(_shares(every), KINDS, strict=True):
        apart = _held(every, *kind, counted=False)
        rows.append({
            "setting": name, "within limits": f"{sum(held)} of {len(held)}", "goal": f"{100 * goal:.0f} %",
            "not counted": f"{sum(apart)} of {len(apart)}" if apart else "",
        })  # fmt: skip
    return rows


def _about(site: Site, results: Sequence[Judged]) -> str:
    """Tracker and settings of a site, in words."""
    text = f"Tracker `{site.tracker}`. Limits: " + "; ".join(f"{s.name}: {s.honest}" for s in (DEFAULTS, CALIBRATED))
    if site.tuned:
        names = ", ".join(f"`{name}`" for name in site.tuned)
        text += f". Instead of a calibration, {names} is fitted to the other recordings"
    if site.levels:
        text += ". At several levels of motion (`track --motion auto`)"
    if not any(one.smoothed for one in results):
        text += ". This tracker has no smoother"
    return text + "."


def _row(one: Judged, best: Mapping[str, float]) -> Row:
    """The figures of a recording; bold where its covariances are outside the limits."""
    metrics = one.metrics
    inside = "" if metrics["coverage_95"] is None else f"{100 * metrics['coverage_95']:.1f} %"
    return {
        "recording": one.recording,
        "setting": SHOWN.get(one.on, one.setting.name),
        "": "smoothed" if one.smoothed else "filtered",
        "RMSE": fixed(metrics["rmse_m"], 3),
        "3-D RMSE": "" if metrics["coverage_95_3d"] is None else fixed(metrics["rmse_3d_m"], 3),
        "inside 95 %": inside,
        "NEES/dof": "" if metrics["nees_ratio"] is None else fixed(metrics["nees_ratio"], 2),
        "covariances": _verdict(one),
        "NIS over 1 s": fixed(metrics["nis_correlation_1s"], 2),
        "baseline": "" if one.smoothed else fixed(best.get(one.recording), 3),
    }


def _verdict(one: Judged) -> str:
    """Whether covariances are within the limits, or to which side they miss them; in brackets if they do not count."""
    if one.holds is None:
        return ""
    (least, _), (_, high) = one.setting.honest
    small = one.metrics["coverage_95"] < least or one.metrics["nees_ratio"] > high
    verdict = "within limits" if one.holds else "**too small**" if small else "**too large**"
    return verdict if one.counted else f"({verdict})"


def _farthest(every: Sequence[Judged]) -> dict[str, Judged]:
    """Of each recording, the estimate farthest outside the room."""
    farthest: dict[str, Judged] = {}
    for one in every:
        if one.recording not in farthest or one.outside > farthest[one.recording].outside:
            farthest[one.recording] = one
    return farthest


def _rooms(every: Sequence[Judged]) -> list[Row]:
    """The estimate farthest outside each room, of those that have one there."""
    rows = []
    for name, one in _farthest(every).items():
        out = one.outside
        if out.distance > 0.0:
            far = fixed(out.distance, 2)
            rows.append({
                "recording": name, "tracker": f"{one.site.tracker}, {one.setting.name}" + ", smoothed" * one.smoothed,
                "outside, m": far if round(out.distance, 2) <= MARGIN else f"**{far}**",
                "at, s": fixed(out.time, 1), "σ there, m": fixed(out.sigma, 2), "rows beyond the limit": str(out.rows),
            })  # fmt: skip
    return rows


def plot_curves(path: Path, every: Sequence[Judged]) -> None:
    """The share of the truth inside the ellipses against their level: a line for each recording, a panel a setting."""
    panels = [partial(_draw_curves, every, *kind) for kind in KINDS]
    write_panels(path, panels, (9.0, 8.6), columns=2, legend=4)


def _draw_curves(every: Sequence[Judged], setting: Setting, smoothed: bool, axes: Axes) -> None:
    results = [one for one in every if (one.setting, one.smoothed) == (setting, smoothed) and one.holds is not None]
    at = [0, *LEVELS, 100]
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="correct covariances")
    # Lines without data stand for the colours, so that every panel has the same legend.
    for colour, verdict in ((BLUE, "within limits"), (VERMILION, "outside the limits"), (GREY, "not counted")):
        axes.plot([], [], color=colour, label=verdict)
    for one in results:
        shares = [0.0, *(100 * one.metrics[f"coverage_{level}"] for level in LEVELS), 100.0]
        colour = GREY if not one.counted else BLUE if one.holds else VERMILION
        axes.plot(at, shares, color=colour, linewidth=1.0, alpha=0.8)
    held = _held(every, setting, smoothed)
    axes.set_title(f"{_named(setting, smoothed)}: {sum(held)} of {len(held)} within limits")
    ticks = [0, 50, 68, 90, 100]
    axes.set(xlim=(0, 100.8), ylim=(0, 100.8), xticks=ticks, yticks=ticks, aspect="equal")
    axes.set(xlabel="level of the ellipse (%)", ylabel="truth inside (%)")


QUOTED = """On public recordings that calibration and tuning have not seen, {missed} of {all} targets for errors
and covariances are missed. Walks with a Bluetooth tag: mean horizontal RMSE {default:.2f} m with default noise levels,
{calibrated:.2f} m ({smoothed:.2f} m smoothed) with stations calibrated on the other walks. Reported covariances are
within limits in {held} recordings with default levels that were set without them, and in {held_calibrated} calibrated
on other recordings of the site ({held_smoothed} smoothed). All figures:
[docs/real-recordings.md](docs/real-recordings.md)
(`python -m trackwright.experiments.lab.validation real-recordings`).
"""


def quoted(every: Sequence[Judged]) -> str:
    """The sentences on these figures for the README."""
    limits = checks(every)

    def walks(setting: Setting, smoothed: bool) -> float:
        shipped = [one for one in every if one.site.name == "walks" and one.on != OTHER_SITES]
        walks = [one for one in shipped if (one.setting, one.smoothed) == (setting, smoothed)]
        return float(np.mean([one.metrics["rmse_m"] for one in walks])) if walks else float("nan")

    held = {name: f"{sum(shares)} of {len(shares)}" for name, _, shares in _shares(every)}
    return QUOTED.format(
        missed=sum(not check.met for check in limits),
        all=len(limits),
        default=walks(DEFAULTS, smoothed=False),
        calibrated=walks(CALIBRATED, smoothed=False),
        smoothed=walks(CALIBRATED, smoothed=True),
        held=held["defaults, filtered"],
        held_calibrated=held["calibrated, filtered"],
        held_smoothed=held["calibrated, smoothed"],
    )


def baselines(readme: Path) -> dict[str, float]:
    """The baselines in the README of the recordings: of each recording the least, over the measurements used."""
    least: dict[str, float] = {}
    if not readme.exists():
        return least
    for line in readme.read_text(encoding="utf-8").partition("### 3-D")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and (metric := re.match(r"[\d.]+", cells[7])):
            least[cells[1]] = min(least.get(cells[1], float("inf")), float(metric[0]))
    return least
