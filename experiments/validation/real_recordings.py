"""Accuracy on real recordings, and tuning without truth: `python -m experiments.validation.real_recordings`.

`errors [CASE ...]` tracks and evaluates every case by the command line, with the tracker's default noise levels or
levels tuned on other recordings, and prints the RMSE beside the baseline in the recordings' README.
`likelihood [CASE ...]` tunes the noise levels by likelihood, without truth, on some recordings of a case and compares
defaults and result on the others. The recordings are not part of this repository: TRACKWRIGHT_RECORDINGS names their
folder, default `../shared/recordings`.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from experiments.cli.runtime import set_flags
from experiments.cli.subprocesses import command, evaluation, recordings_folder
from experiments.reports.tables import aligned
from trackers.core.errors import UnusableInput

OUT = Path("out/real-recordings")

WORSE = 1.02
"""Ratio of held-out RMSE above which tuning by likelihood counts as worse than the defaults."""

SEGMENT_ROWS = 4000


class Case(NamedTuple):
    """Recordings of one kind, their tracker, and how it is tuned.

    `tuned_on`: other recordings, or some of `scored`, that are tuned on. `tune`: options of `tune` before `errors`;
    without them the defaults hold. `likelihood`: tunables of the comparison by likelihood. `tracked`: scored by
    `errors`. `smooth`: also smoothed. `free_height`: also with unknown height.
    """

    tracker: str
    scored: tuple[str, ...]
    tuned_on: tuple[str, ...] = ()
    tune: tuple[str, ...] = ()
    likelihood: tuple[str, ...] = ()
    tracked: bool = True
    smooth: bool = True
    free_height: bool = False


WALK_TUNABLES = ("motion.*", "sensors.*.sigma_*", "sensors.*.dof", "sensors.*.offsets", "sensors.*.compression")

CASES = {
    # From the tracker's own levels alone: other starts find smaller errors on the three walks that do not generalise.
    "walks": Case(
        "bearings",
        scored=tuple(f"ble51-walk-u{k}-r2" for k in (1, 2, 3)),
        tuned_on=tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3)),
        tune=(
            "--free-height",
            "--objective",
            "rmse",
            "--dimensions",
            "3",
            "--steps",
            "80",
            "--starts",
            "1",
            "--tune",
            *WALK_TUNABLES,
        ),
        likelihood=("*.sigma_*",),
        free_height=True,
    ),
    "uca": Case(
        "beam",
        scored=tuple(f"ble51-uca-{point}" for point in ("x1y1", "x2y2", "x4y2")),
        tuned_on=tuple(f"ble51-uca-{point}" for point in ("x0y2", "x2y0", "x3y3")),
        likelihood=("*.sigma_*",),
        tracked=False,
    ),
    "starloc": Case("uwb", scored=("starloc-fast-s1", "starloc-2d-s5")),
    "starloc-imu": Case("uwb-imu", scored=("starloc-fast-s1",)),
    "drones": Case("uwb", scored=("iasl-drone-1", "rcv-drone-3")),
    "trolley": Case(
        "uwb",
        scored=("lias-planar-fast",),
        tuned_on=("lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0"),
        tune=("--objective", "rmse", "--dimensions", "3", "--tune", "sensors.*.bias", "--steps", "20"),
        likelihood=("*.sigma_r", "*.sigma_bias"),
    ),
    "labyrinth": Case("uwb", scored=("labyrinth",)),
    "line": Case(
        "line-grid",
        scored=("ngbui-line-1-1", "ngbui-line-2-1", "ngbui-line-3-1"),
        tuned_on=("ngbui-line-1-1",),
        likelihood=("*.sigma_*",),
        smooth=False,
    ),
    "tiers": Case(
        "fix-mirror",
        scored=("tiers-2tag-01", "tiers-2tag-03", "tiers-2tag-06"),
        tuned_on=("tiers-1tag-01",),
        tune=("--objective", "rmse", "--dimensions", "3", "--tune", "*latency*"),
        likelihood=("*.sigma_*",),
    ),
}

Cases = Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[CASE ...]")]


def errors(cases: Cases = ()) -> int:
    """Track and evaluate cases, smoothed too where the tracker has a smoother, and print their RMSE.

    Args:
        cases: names of cases; all where none is named.
    """
    folder, chosen = _chosen(cases)
    best = baselines(folder / "README.md")
    head = ("recording", "tracker", "horizontal", "smoothed", "baseline", "3-D", "smoothed", "baseline")
    rows = [row for name in chosen if CASES[name].tracked for row in tracked(folder, name, CASES[name], best)]
    print("\nRMSE in m; the baseline is a Kalman filter tuned on the same recording")
    print(aligned([head, *rows], range(2, len(head))))
    return 0


def tracked(folder: Path, name: str, case: Case, best: Mapping[tuple[str, bool], float]) -> list[tuple[str, ...]]:
    """The table's rows of one case."""
    noise: Sequence[str | Path] = ()
    if case.tune:
        out = OUT / name / "tuned"
        others = [folder / other for other in case.tuned_on]
        command("tune", *others, "--tracker", case.tracker, *case.tune, "--out", out)
        noise = ("--noise", out / "tuned.toml")

    def metrics(kind: str, *options: str) -> dict[str, dict[str, Any]]:
        paths, out = [folder / recording for recording in case.scored], OUT / name / kind
        command("track", *paths, "--tracker", case.tracker, *noise, *options, "--out", out)
        return {found["recording"]: found for found in evaluation(out)["recordings"]}

    filtered = metrics("filtered")
    smoothed = metrics("smoothed", "--smooth") if case.smooth else {}
    runs = [(case.tracker, filtered, smoothed)]
    if case.free_height:
        runs.append((f"{case.tracker} --free-height", metrics("free-height", "--free-height"), {}))
    rows: list[tuple[str, ...]] = []
    for tracker, errors_by_name, smoothed_by_name in runs:
        for recording, found in errors_by_name.items():
            cells = [
                _cell(x)
                for key, spatial in (("rmse_m", False), ("rmse_3d_m", True))
                for x in (found[key], smoothed_by_name.get(recording, {}).get(key), best.get((recording, spatial)))
            ]
            rows.append((recording, tracker, *cells))
    return rows


def _cell(metric: float | None) -> str:
    return "" if metric is None else f"{metric:.3f}"


def baselines(readme: Path) -> dict[tuple[str, bool], float]:
    """RMSE, m, of the tuned Kalman filter by recording and whether it is 3-D, from the recordings' README.

    The least of a recording's rows there, which differ in the measurements used.
    """
    found: dict[tuple[str, bool], float] = {}
    spatial = False
    for line in readme.read_text(encoding="utf-8").splitlines():
        if line.startswith("### "):
            spatial = line.startswith("### 3-D")
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and (metric := re.match(r"[\d.]+", cells[7])):
            key = cells[1], spatial
            found[key] = min(found.get(key, float("inf")), float(metric[0]))
    return found


def likelihood(cases: Cases = ()) -> int:
    """Tune cases by likelihood and print held-out metrics before and after; 1 if the RMSE of a case got worse.

    Args:
        cases: names of cases; all that have tunables for it where none is named.
    """
    folder, chosen = _chosen(cases)
    print(f"{'case':10s}{'tracker':12s}{'metric, on recordings not tuned on':38s}{'before':>10s}{'after':>10s}")
    worse = [name for name in chosen if CASES[name].likelihood and compared(folder, name, CASES[name])]
    print("worse by likelihood: " + (", ".join(worse) or "none"))
    return int(bool(worse))


def compared(folder: Path, name: str, case: Case) -> bool:
    """Tune one case by likelihood, print its held-out metrics, and return whether the RMSE got worse."""
    set_flags()
    from trackers.catalogue import build, fitting
    from trackers.recordings.folder import read_recording
    from trackers.recordings.tracks import batches
    from tuning import fit
    from tuning.data import fit_data
    from tuning.diagnostics import innovations_of, violated_assumptions
    from tuning.named_objectives import all_metrics

    began, indent = time.perf_counter(), " " * 22
    training = [read_recording(folder / x) for x in case.tuned_on]
    tracker = case.tracker or fitting(training[0])
    default = build(tracker, training)
    data = fit_data(default.only_batch(training), "nll", segment_rows=SEGMENT_ROWS)
    result = fit(data.tracker, data.rows(), data.objective, case.likelihood, starts=2)
    tuned = default.with_values({k: result.values[p.label] for p in result.parameters for k in p.names}, name)
    worse = False
    held_out = [read_recording(folder / x) for x in case.scored if x not in case.tuned_on]
    # Recordings with another path or other anchors have a tracker of their own, which takes the values by name.
    for scored, after_tuning in zip(default.batches(held_out), tuned.batches(held_out), strict=True):
        rows = [batch for _, batch in batches(scored.trajectories)]
        quantity = next(iter(scored.trajectories[0].recording.truth))
        dimensions = 2 if scored.planar or quantity == "direction" else 3
        tuned_tracker = after_tuning.tracker
        before, after = (all_metrics(t, rows, quantity, dimensions) for t in (scored.tracker, tuned_tracker))
        print(f"{name:10s}{tracker:12s}{', '.join(sorted({x.folder.name for x in scored.trajectories}))}")
        for metric in ("nll", "rmse", "rmse-3d", "nis-shape"):
            if before[metric] == before[metric]:
                print(f"{indent}{metric:38s}{before[metric]:10.4g}{after[metric]:10.4g}", flush=True)
        if after["rmse"] > WORSE * before["rmse"]:
            worse = True
            runs = [(tuned_tracker.run(x), x.size) for x in rows]
            innovations = innovations_of(tuned_tracker, [found[k] for found, size in runs for k in range(size)])
            reasons = [] if innovations is None else violated_assumptions(innovations)
            print(f"{indent}worse; the innovations contradict: {'; '.join(reasons) or 'nothing'}", flush=True)
    listed = ", ".join(f"{k} {v:.3g}" for k, v in result.values.items() if v.ndim == 0)
    print(f"{indent}{time.perf_counter() - began:.0f} s; {listed}", flush=True)
    return worse


def _chosen(cases: Sequence[str]) -> tuple[Path, Sequence[str]]:
    """The folder of recordings and the names of the cases; raises UnusableInput for either."""
    if unknown := [name for name in cases if name not in CASES]:
        raise UnusableInput(f"unknown case: {', '.join(unknown)}; expected some of {', '.join(CASES)}")
    if (folder := recordings_folder()) is None:
        raise UnusableInput(
            "no folder of real recordings; expected ../shared/recordings or a folder named by TRACKWRIGHT_RECORDINGS"
        )
    return folder, cases or list(CASES)


def main() -> int:
    """Run `errors` or `likelihood`; 2 for unusable input."""
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            {"errors": errors, "likelihood": likelihood},
            prog="python -m experiments.validation.real_recordings",
            description="Accuracy on real recordings, and tuning without truth.",
        )
    except UnusableInput as problem:
        print(f"real_recordings: {problem}", file=sys.stderr)
        return 2
    return code


if __name__ == "__main__":
    sys.exit(main())
