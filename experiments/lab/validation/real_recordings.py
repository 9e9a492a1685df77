"""Accuracy and covariances on real recordings: every fold of `folds.FOLDS` against its limits.

No fold is judged on a recording that its calibration or tuning has seen. The recordings are not part of this
repository: TRACKWRIGHT_RECORDINGS names their folder, default `../shared/recordings`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import DEFAULTS, LAB, Output, Row, Table, shown
from trackwright.experiments.lab.subprocesses import REPOSITORY, required_recordings
from trackwright.experiments.lab.validation.folds import (
    BY_DEFAULTS,
    FOLDS,
    MARGIN,
    OTHER_HALF,
    OTHERS,
    SEEN_BY_DEFAULTS,
    Check,
    Figures,
    Fold,
    checks,
    covariance_checks,
    mean_of,
    run_fold,
)
from trackwright.experiments.text.tables import replace_tables
from trackwright.experiments.text.wording import fixed
from trackwright.trackers.evaluation.evaluate import Metrics
from trackwright.trackers.evaluation.statements import covariance_statements

PAGE = REPOSITORY / "docs" / "real-recordings.md"


def real_recordings(*, output: Output = DEFAULTS) -> int:
    """Accuracy and covariances on real recordings against limits; with `--small` a part of them. 1 where one is missed.

    With `--page docs/real-recordings.md` also the summary in the README is written.
    """
    keep_programs()
    best, figures = baselines(required_recordings() / "README.md"), []
    for fold in (fold for fold in FOLDS if fold.quick or not output.small):
        for one in run_fold(fold):
            shown([{"fold": fold.name, **_row(one, best)}])
            figures.append(one)
    output.publish("validation real-recordings", *tables(figures, best))
    if output.page is not None and output.page.resolve() == PAGE:
        replace_tables(REPOSITORY / "README.md", f"{LAB}.validation real-recordings", quoted(figures))
    missed = [check for check in all_checks(figures) if not check.met]
    for check in missed:
        print(f"missed: {check}")
    return int(bool(missed))


def tables(figures: Sequence[Figures], best: Mapping[str, float]) -> list[Table]:
    """The tables of the page; `best`: the baselines, m, by recording."""
    every = all_checks(figures)
    verdict = f"**{sum(check.met for check in every)} of {len(every)} limits are met.**"
    return [
        Table(_summary(figures), "Summary", verdict),
        *(_section(fold, list(group), best) for fold, group in groupby(figures, key=lambda one: one.fold)),
        Table(_rooms(figures), "Rooms"),
    ]


QUOTED = """On public recordings that calibration and tuning have not seen, {missed} of {all} targets for errors
and covariances are still missed. Walks with a Bluetooth tag: mean horizontal RMSE {default:.2f} m with default noise
levels, {calibrated:.2f} m ({smoothed:.2f} m smoothed) with stations calibrated on earlier walks. Reported uncertainty
is on target in {held} of {judged} recordings ({held_smoothed} of {judged_smoothed} smoothed); some of them were used to
choose the defaults. All figures: [docs/real-recordings.md](docs/real-recordings.md)
(`python -m trackwright.experiments.lab.validation real-recordings`).
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
    of_folds = [
        check for fold, group in groupby(figures, key=lambda one: one.fold) for check in checks(fold, list(group))
    ]
    outside = {name: round(one.outside.distance, 2) for name, one in _farthest(figures).items()}
    return of_folds + [Check("room", "m outside", distance, 0.0, MARGIN, name) for name, distance in outside.items()]


def baselines(readme: Path) -> dict[str, float]:
    """The baselines in the README of the recordings: of each recording the least, over the measurements used."""
    least: dict[str, float] = {}
    for line in readme.read_text(encoding="utf-8").partition("### 3-D")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and (metric := re.match(r"[\d.]+", cells[7])):
            least[cells[1]] = min(least.get(cells[1], float("inf")), float(metric[0]))
    return least


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


def _summary(figures: Sequence[Figures]) -> list[Row]:
    """Means over the recordings of each fold beside their limits."""
    rows = []
    for fold, group in groupby(figures, key=lambda one: one.fold):
        of_fold = list(group)
        means = [_with_limit(mean_of(of_fold, metric, smoothed), limit) for _, metric, smoothed, limit in fold.limits]
        if all(one.metrics["coverage_95_3d"] is None for one in of_fold):
            means[2] = ""
        names = ("RMSE, m", "RMSE smoothed, m", "3-D RMSE, m")
        held = [_held([one for one in of_fold if one.smoothed == smoothed]) for smoothed in (False, True)]
        on_target = zip(("covariances on target", "smoothed on target"), held, strict=True)
        rows.append({"fold": fold.name, **dict(zip(names, means, strict=True)), **dict(on_target)})
    return rows


def _with_limit(figure: float, limit: float | None) -> str:
    text = "" if figure != figure else fixed(figure, 3)
    return text if limit is None or not text else f"{_marked(text, round(figure, 3) <= limit)} (≤ {limit:g})"


def _held(figures: Sequence[Figures]) -> str:
    """In how many recordings the limits of covariances are met."""
    met = [all(check.met for check in limits) for limits in map(covariance_checks, figures) if limits]
    return _marked(f"{sum(met)} of {len(met)}", all(met)) if met else ""


def _marked(text: str, met: bool) -> str:
    return text if met else f"**{text}**"


def _section(fold: Fold, figures: Sequence[Figures], best: Mapping[str, float]) -> Table:
    """The figures of the recordings of a fold, and what the innovations alone show of those outside `BY_DEFAULTS`."""
    about = [f"Tracker `{fold.tracker}`; {saw(fold)}. {f'Limits: {fold.honest}.' if fold.honest else 'No limits.'}"]
    if not any(one.smoothed for one in figures):
        about.append("This tracker has no smoother.")
    lines = []
    for one in figures:
        if not one.smoothed and not _as_expected(one.metrics):
            without_truth = {**one.metrics, "coverage_95": None, "recording": one.recording}
            statements = covariance_statements(without_truth, [without_truth])
            lines.append(f"- {one.recording}: {statements[-1] if statements else 'the tracker has no innovations.'}")
    if lines:
        missing = f"Recordings that miss the targets of default levels ({BY_DEFAULTS}), by their innovations alone:"
        about += [missing, "\n".join(lines)]
    return Table([_row(one, best) for one in figures], fold.name[0].upper() + fold.name[1:], "\n\n".join(about))


def _as_expected(metrics: Metrics) -> bool:
    """Whether the covariances are within the targets of default noise levels, or none is reported."""
    share, ((least, most), (low, high)) = metrics["coverage_95"], BY_DEFAULTS
    return share is None or (least <= share <= most and low <= metrics["nees_ratio"] <= high)


def _row(one: Figures, best: Mapping[str, float]) -> Row:
    """The figures of a recording, those bold that miss their limits."""
    metrics, kind = one.metrics, "smoothed" if one.smoothed else "filtered"
    met = [check.met for check in covariance_checks(one)] or [True, True]
    inside = "" if metrics["coverage_95"] is None else f"{100 * metrics['coverage_95']:.1f} %"
    return {
        "recording": one.recording + "*" * (one.recording in SEEN_BY_DEFAULTS.get(one.fold.tracker, ())),
        "": kind,
        "RMSE": fixed(metrics["rmse_m"], 3),
        "3-D RMSE": "" if metrics["coverage_95_3d"] is None else fixed(metrics["rmse_3d_m"], 3),
        "inside 95 %": _marked(inside, met[0]),
        "NEES/dof": _marked(fixed(metrics["nees_ratio"], 2), met[1]),
        "NIS over 1 s": fixed(metrics["nis_correlation_1s"], 2),
        "baseline": "" if one.smoothed else fixed(best.get(one.recording), 3),
    }


def _farthest(figures: Sequence[Figures]) -> dict[str, Figures]:
    """The figures with the estimate farthest outside the room, by recording."""
    farthest: dict[str, Figures] = {}
    for one in figures:
        if one.recording not in farthest or one.outside > farthest[one.recording].outside:
            farthest[one.recording] = one
    return farthest


def _rooms(figures: Sequence[Figures]) -> list[Row]:
    """The estimate farthest outside each room."""
    rows = []
    for name, one in _farthest(figures).items():
        out, is_outside = one.outside, one.outside.distance > 0
        where = one.fold.name + (", smoothed" if one.smoothed else "")
        rows.append({
            "recording": name, "in the fold": where if is_outside else "",
            "outside, m": _marked(fixed(out.distance, 2), round(out.distance, 2) <= MARGIN),
            "at, s": fixed(out.time, 1) if is_outside else "", "σ there, m": fixed(out.sigma, 2) if is_outside else "",
            "rows beyond the limit": str(out.rows) if is_outside else "",
        })  # fmt: skip
    return rows


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
