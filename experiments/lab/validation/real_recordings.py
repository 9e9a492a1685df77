"""Accuracy and covariances on real recordings: `python -m trackwright.experiments.lab.validation.real_recordings`.

Runs every fold of `folds.FOLDS`, writes `docs/real-recordings.md` and its summary in the README, and ends with exit
code 1 where a limit is missed. No fold is judged on a recording that its calibration or tuning has seen. The recordings
are not part of this repository: TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

import platform
import re
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import groupby
from pathlib import Path

from trackwright.experiments.cli.main import run_alone
from trackwright.experiments.cli.runtime import keep_programs, set_flags
from trackwright.experiments.lab.bench.timing import replace_tables
from trackwright.experiments.lab.subprocesses import REPOSITORY, required_recordings
from trackwright.experiments.lab.validation.fold_runs import (
    MARGIN,
    Check,
    Figures,
    checks,
    covariance_checks,
    mean_of,
    run_fold,
)
from trackwright.experiments.lab.validation.folds import DEFAULTS, FOLDS, OTHER_HALF, OTHERS, SEEN_BY_DEFAULTS, Fold
from trackwright.experiments.text.tables import markdown
from trackwright.experiments.text.wording import fixed
from trackwright.trackers.evaluation.evaluate import Metrics
from trackwright.trackers.evaluation.statements import covariance_statements

MODULE = "trackwright.experiments.lab.validation.real_recordings"
PAGE = REPOSITORY / "docs" / "real-recordings.md"
QUICK_PAGE = Path("out/real-recordings.md")
PACKAGES = ("trackwright", "jax", "numpy")

INTRODUCTION = """# Accuracy and covariances on real recordings

`{command}`, {date}, {seconds:.0f} s; seed 0; {versions}.
{verdict}

The recordings are public data sets in the format of [formats.md](formats.md). They are not part of this repository; the
command finds them through `TRACKWRIGHT_RECORDINGS` (default `../shared/recordings`). Folds and limits are declared in
`experiments/lab/validation/folds.py`. No figure is of a recording that its calibration or tuning has seen, with two
restrictions:

- Default noise levels of `bearings`, `uwb`, `uwb-imu` and `fix-mirror` were set on some of the recordings, which are
  marked by * (of the first two by `python -m trackwright.experiments.lab.validation.default_levels`, then partly by
  hand, see [decisions.md](decisions.md)); those of the other trackers were chosen with these recordings at hand. Such
  figures show how one set of levels fits several kinds of recordings, and are no prediction for others.
- Where a site has only one recording, each half of it, in time, is calibrated on the other half. Later changes of the
  site do not show in these figures.
"""

LIMITS = """## Summary

Means over the recordings of each fold, with their limits; bold figures miss them. Covariances: in how many recordings
both the share inside the 95 % ellipse and NEES/dof are within their limits, which are targets of these recordings and
wider or narrower than those of the verdict of `track` ([formats.md](formats.md)). Figures are compared as printed.
"""

FIGURES = """## Figures by recording

RMSE in m, horizontal unless it is called 3-D. Inside 95 %: share of the rows whose 95 % ellipse over the floor contains
the truth. NIS over 1 s: autocorrelation of the normalised innovations squared, 0 for a model that fits. Baseline:
horizontal RMSE of a Kalman filter with constant velocity whose noise levels were tuned on the judged recording itself.
Bold figures miss their limits; * marks recordings on which default noise levels were set.
"""

ROOMS = """## Rooms

The estimate farthest outside the room, over all folds, filtered and smoothed. The room is the horizontal box around
anchors, stations and truth; the limit is {margin:.0f} m, whatever the reported standard deviation.
"""

SOURCES = """## Sources

- ble51-walk: M. Girolami et al., IEEE Access 2023: walks with Bluetooth arrays that report angles in steps of 2°
- starloc: F. Dümbgen et al., arXiv:2309.05518; a rig with UWB tags, moved by hand
- lias: H. Jiang et al., ICRA 2023, arXiv:2209.06779; a trolley with three UWB tags
- rcv-drone: J. H. Choe and I. Shim, arXiv:2407.03890; iasl-drone: github.com/i-ASL/uwb_imu_dataset
- labyrinth: T. Pfeifer and P. Protzel, ICRA 2019, DOI 10.1109/ICRA.2019.8793601
- ngbui-line: github.com/ngbui101/bachelorarbeit-uwb-imu-ekf; a UWB tag on a known straight path, partly obstructed
- tiers: J. Peña Queralta et al., IROS 2020, DOI 10.1109/IROS45743.2020.9341042; position fixes of drones, late and
  at times mirrored in the plane of the anchors
"""


def written(figures: Sequence[Figures], best: Mapping[str, float], command: str, seconds: float) -> str:
    """The page as Markdown; `best`: the baselines, m, by recording."""
    every = all_checks(figures)
    missed = [check for check in every if not check.met]
    versions = ", ".join([f"{name} {version(name)}" for name in PACKAGES] + [f"Python {platform.python_version()}"])
    verdict, date = f"**{len(every) - len(missed)} of {len(every)} limits are met.**", f"{datetime.now(UTC):%Y-%m-%d}"
    parts = [
        INTRODUCTION.format(command=command, date=date, seconds=seconds, versions=versions, verdict=verdict),
        LIMITS,
        _summary(figures),
        FIGURES,
        *(_section(fold, list(own), best) for fold, own in groupby(figures, key=lambda one: one.fold)),
        ROOMS.format(margin=MARGIN),
        _rooms(figures),
        SOURCES,
    ]
    return "\n".join(parts)


QUOTED = """On public recordings that calibration and tuning have not seen, {missed} of {all} targets for errors
and covariances are still missed. Walks with a Bluetooth tag: mean horizontal RMSE {default:.2f} m with default noise
levels, {calibrated:.2f} m ({smoothed:.2f} m smoothed) with stations calibrated on earlier walks. Reported uncertainty
is on target in {held} of {judged} recordings ({held_smoothed} of {judged_smoothed} smoothed); some of them were used to
choose the defaults. All figures: [docs/real-recordings.md](docs/real-recordings.md)
(`python -m trackwright.experiments.lab.validation.real_recordings`).
"""


def quoted(figures: Sequence[Figures]) -> str:
    """The sentences on these figures for the README."""
    every = all_checks(figures)

    def walks(name: str, smoothed: bool) -> float:
        return mean_of([one for one in figures if one.fold.name == name], "rmse_m", smoothed)

    judged = [(one.smoothed, limits) for one in figures if (limits := covariance_checks(one))]
    held = [smoothed for smoothed, limits in judged if all(check.met for check in limits)]
    return QUOTED.format(
        missed=sum(not check.met for check in every),
        all=len(every),
        default=walks("walks", smoothed=False),
        calibrated=walks("walks, calibrated", smoothed=False),
        smoothed=walks("walks, calibrated", smoothed=True),
        held=held.count(False),
        judged=sum(not smoothed for smoothed, _ in judged),
        held_smoothed=held.count(True),
        judged_smoothed=sum(smoothed for smoothed, _ in judged),
    )


def all_checks(figures: Sequence[Figures]) -> list[Check]:
    """The limits of all folds, then those of rooms."""
    found = [check for fold, own in groupby(figures, key=lambda one: one.fold) for check in checks(fold, list(own))]
    outside = {name: round(one.outside.distance, 2) for name, one in _farthest(figures).items()}
    return found + [Check("room", "m outside", distance, 0.0, MARGIN, name) for name, distance in outside.items()]


def line_of(figures: Figures) -> str:
    """The figures of a recording in one line, for the terminal."""
    cells = [cell.replace("*", "") for cell in _cells(figures)]
    return f"{figures.fold.name:26s} {figures.recording:18s} " + "  ".join(f"{cell:>8s}" for cell in cells)


def baselines(readme: Path) -> dict[str, float]:
    """The baselines in the README of the recordings: of each recording the least, over the measurements used."""
    found: dict[str, float] = {}
    for line in readme.read_text(encoding="utf-8").partition("### 3-D")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and (metric := re.match(r"[\d.]+", cells[7])):
            found[cells[1]] = min(found.get(cells[1], float("inf")), float(metric[0]))
    return found


def saw(fold: Fold) -> str:
    """The recordings that the figures of a fold have seen, in words."""
    on = fold.calibrated_on
    if on in (OTHER_HALF, OTHERS):
        parts = [f"each calibrated on {''.join(on)}"]
    else:
        parts = [f"calibrated on {_listed(on)}" if on else "not calibrated"]
    if fold.tuned_on:
        tunables = ", ".join(f"`{name}`" for name in fold.tuned)
        parts.append(f"{tunables} tuned on {_listed(fold.tuned_on)}")
    return "; ".join([*parts, "height unknown"] if fold.free_height else parts)


def _summary(figures: Sequence[Figures]) -> str:
    rows = []
    for fold, group in groupby(figures, key=lambda one: one.fold):
        own = list(group)
        means = [_with_limit(mean_of(own, metric, smoothed), limit) for _, metric, smoothed, limit in fold.limits]
        if all(one.metrics["coverage_95_3d"] is None for one in own):
            means[2] = ""
        rows.append((fold.name, *means, *(_honest([one for one in own if one.smoothed == s]) for s in (False, True))))
    head = ("fold", "RMSE, m", "smoothed", "3-D RMSE, m", "covariances on target", "smoothed")
    return markdown([head, *rows], range(1, 6))


def _with_limit(figure: float, limit: float | None) -> str:
    text = "" if figure != figure else fixed(figure, 3)
    return text if limit is None or not text else f"{_marked(text, round(figure, 3) <= limit)} (≤ {limit:g})"


def _honest(own: Sequence[Figures]) -> str:
    """In how many recordings the limits of covariances are met."""
    found = [all(check.met for check in limits) for limits in map(covariance_checks, own) if limits]
    return _marked(f"{sum(found)} of {len(found)}", all(found)) if found else ""


def _marked(text: str, met: bool) -> str:
    return text if met else f"**{text}**"


def _section(fold: Fold, own: Sequence[Figures], best: Mapping[str, float]) -> str:
    smoothed = {one.recording for one in own if one.smoothed}
    rows = []
    for one in own:
        name = one.recording + "*" * (one.recording in SEEN_BY_DEFAULTS.get(fold.tracker, ()))
        kind, baseline = ("smoothed", "") if one.smoothed else ("filtered", fixed(best.get(one.recording), 3))
        rows.append((name, kind, *_cells(one), baseline))
    head = ("recording", "", "RMSE", "3-D RMSE", "inside 95 %", "NEES/dof", "NIS over 1 s", "baseline")
    title = f"### {fold.name[0].upper()}{fold.name[1:]}\n\nTracker `{fold.tracker}`; {saw(fold)}. {_limits(fold)}\n"
    note = "" if smoothed else "\nThis tracker has no smoother.\n"
    return f"{title}\n{markdown([head, *rows], range(2, 8))}{note}{_innovations(own)}"


def _limits(fold: Fold) -> str:
    if fold.honest is None:
        return "No limits."
    (least, most), (low, high) = fold.honest
    return f"Limits: inside 95 %: {100 * least:.0f} to {100 * most:.0f} %, NEES/dof {low:g} to {high:g}."


def _innovations(own: Sequence[Figures]) -> str:
    """What the innovations alone show of the recordings outside the targets of `DEFAULTS`; nothing without any."""
    lines = []
    for one in own:
        if not one.smoothed and not _as_expected(one.metrics):
            without_truth = {**one.metrics, "coverage_95": None, "recording": one.recording}
            found = covariance_statements(without_truth, [without_truth])
            lines.append(f"- {one.recording}: {found[-1] if found else 'the tracker has no innovations.'}\n")
    (least, most), (low, high) = DEFAULTS
    outside = f"outside {100 * least:.0f} to {100 * most:.0f} % or NEES/dof {low:g} to {high:g}"
    return (
        "".join(["\nThe innovations of recordings ", outside, " (filtered), without truth:\n\n", *lines])
        if lines
        else ""
    )


def _as_expected(metrics: Metrics) -> bool:
    """Whether the covariances are within the targets of `DEFAULTS`, or none is reported."""
    share, ((least, most), (low, high)) = metrics["coverage_95"], DEFAULTS
    return share is None or (least <= share <= most and low <= metrics["nees_ratio"] <= high)


def _cells(one: Figures) -> list[str]:
    metrics = one.metrics
    met = [check.met for check in covariance_checks(one)] or [True, True]
    return [
        fixed(metrics["rmse_m"], 3),
        "" if metrics["coverage_95_3d"] is None else fixed(metrics["rmse_3d_m"], 3),
        "" if metrics["coverage_95"] is None else _marked(f"{100 * metrics['coverage_95']:.1f} %", met[0]),
        _marked(fixed(metrics["nees_ratio"], 2), met[1]),
        fixed(metrics["nis_correlation_1s"], 2),
    ]


def _farthest(figures: Sequence[Figures]) -> dict[str, Figures]:
    """The figures with the estimate farthest outside the room, by recording."""
    found: dict[str, Figures] = {}
    for one in figures:
        if one.recording not in found or one.outside > found[one.recording].outside:
            found[one.recording] = one
    return found


def _rooms(figures: Sequence[Figures]) -> str:
    rows = []
    for name, one in _farthest(figures).items():
        out = one.outside
        where = one.fold.name + (", smoothed" if one.smoothed else "")
        at = (fixed(out.time, 1), fixed(out.sigma, 2), str(out.rows)) if out.distance > 0 else ("", "", "")
        distance = _marked(fixed(out.distance, 2), round(out.distance, 2) <= MARGIN)
        rows.append((name, where if out.distance > 0 else "", distance, *at))
    head = ("recording", "in the fold", "outside, m", "at, s", "σ there, m", "rows beyond the limit")
    return markdown([head, *rows], range(2, 6))


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def main(*, quick: bool = False, page: Path | None = None) -> int:
    """Run the folds, write the page, and return 1 where a limit is missed.

    Args:
        quick: the folds of two minutes alone; their page is out/real-recordings.md.
        page: the page to write; default docs/real-recordings.md.
    """
    set_flags()
    keep_programs()
    root = required_recordings()
    began = time.monotonic()
    figures = []
    for fold in (fold for fold in FOLDS if fold.quick or not quick):
        for one in run_fold(fold, root):
            print(line_of(one), flush=True)
            figures.append(one)
    seconds = time.monotonic() - began
    options = " --quick" if quick else ""
    command = f"python -m {MODULE}{options}"
    out = page or (QUICK_PAGE if quick else PAGE)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(written(figures, baselines(root / "README.md"), command, seconds), "utf-8")
    if out == PAGE:
        replace_tables(REPOSITORY / "README.md", MODULE, quoted(figures))
    missed = [check for check in all_checks(figures) if not check.met]
    print(f"Written: {out} ({seconds:.0f} s)")
    for check in missed:
        print(f"missed: {check}")
    return int(bool(missed))


if __name__ == "__main__":
    run_alone(main, f"python -m {MODULE}")
