"""Real recordings tuned by likelihood, without truth: tuned on some of each group, evaluated on the others.

`python -m experiments.validation.tuned_recordings [GROUP …]` prints objective, RMSE and distance of NIS from its
distribution on the recordings that were not tuned on, before (the tracker's defaults) and after. The recordings are not
part of this repository: TRACKWRIGHT_RECORDINGS, default `../shared/recordings`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.cli.runtime import set_flags

set_flags()

from experiments.cli.subprocesses import real_recordings  # noqa: E402
from experiments.cli.tuning_job import job_of, only_group  # noqa: E402
from trackers.catalogue import spec_of  # noqa: E402
from trackers.core.tunable import tunables, with_values  # noqa: E402
from trackers.recordings.folder import read_recording  # noqa: E402
from trackers.recordings.tracks import batches  # noqa: E402
from tuning import NegativeLogLikelihood, fit  # noqa: E402
from tuning.diagnostics import innovations_of, violated_assumptions  # noqa: E402
from tuning.named_objectives import all_metrics  # noqa: E402

WORSE = 1.02
"""Ratio of held-out RMSE after to before from which tuning by likelihood counts as worse."""

PIECE_ROWS = 4000


class Split(NamedTuple):
    """Recordings of one group: those tuned on, those evaluated, the tracker (None: by the tables), tuned parameters."""

    tuned: tuple[str, ...]
    evaluated: tuple[str, ...]
    tracker: str | None = None
    tune: tuple[str, ...] = ("*.sigma_*",)


GROUPS = {
    "walks": Split(tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3)), tuple(f"ble51-walk-u{k}-r2" for k in (1, 2, 3))),
    "uca": Split(
        tuple(f"ble51-uca-{p}" for p in ("x0y2", "x2y0", "x3y3")),
        tuple(f"ble51-uca-{p}" for p in ("x1y1", "x2y2", "x4y2")),
        "beam",
    ),
    "lias": Split(
        ("lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0"),
        ("lias-planar-fast",),
        "uwb",
        ("*.sigma_r", "*.sigma_bias"),
    ),
    "ngbui": Split(("ngbui-line-1-1",), ("ngbui-line-2-1", "ngbui-line-3-1"), "line-grid"),
    "tiers": Split(("tiers-1tag-01",), ("tiers-2tag-01", "tiers-2tag-03", "tiers-2tag-06"), "fix-mirror"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Tune and evaluate the groups named, or all; 1 where the RMSE of one got worse."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.validation.tuned_recordings", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}; all where none is named")
    names = parser.parse_args(arguments).groups
    if unknown := [name for name in names if name not in GROUPS]:
        parser.error(f"unknown: {', '.join(unknown)}; expected of {', '.join(GROUPS)}")
    folder = real_recordings()
    if folder is None:
        parser.error("no folder of real recordings, expected ../shared/recordings or what TRACKWRIGHT_RECORDINGS names")
    print(f"{'group':8s}{'tracker':12s}{'metric, on recordings not tuned on':38s}{'before':>10s}{'after':>10s}")
    worse = [name for name in names or GROUPS if got_worse(name, GROUPS[name], folder)]
    print("worse by likelihood: " + (", ".join(worse) or "none"))
    return int(bool(worse))


def got_worse(name: str, split: Split, folder: Path) -> bool:
    """Tune one group, print its metrics, and return whether the RMSE got worse."""
    began = time.perf_counter()
    tracker, group = only_group([folder / x for x in split.tuned], split.tracker, None, False)
    job = job_of(group, "nll", [], PIECE_ROWS)
    result = fit(job.tracker, job.rows(), NegativeLogLikelihood(), split.tune, starts=2)
    numbers = tunables(result.tracker)
    tuned = {k: numbers[k].value for p in result.parameters for k in p.names}
    worse = False
    # Recordings with another path or other anchors have another tracker, whose parameters are set by name.
    for batch_group in spec_of(tracker).batches([read_recording(folder / x) for x in split.evaluated], tracker, False):
        rows = [batch for _, batch in batches(batch_group.trajectories)]
        quantity = next(iter(batch_group.trajectories[0].recording.truth))
        dimensions = 2 if batch_group.planar or quantity == "direction" else 3
        tracked = with_values(batch_group.tracker, tuned, name)
        before, after = (all_metrics(t, rows, quantity, dimensions) for t in (batch_group.tracker, tracked))
        print(f"{name:8s}{tracker:12s}{', '.join(sorted({x.folder.name for x in batch_group.trajectories}))}")
        for metric in ("nll", "rmse", "rmse-3d", "nis-shape"):
            if before[metric] == before[metric]:
                print(f"{'':20s}{metric:38s}{before[metric]:10.4g}{after[metric]:10.4g}", flush=True)
        if after["rmse"] > WORSE * before["rmse"]:
            worse = True
            runs = [(tracked.run(x), x.size) for x in rows]
            innovations = innovations_of(tracked, [found[k] for found, size in runs for k in range(size)])
            why = [] if innovations is None else violated_assumptions(innovations)
            print(f"{'':20s}worse; the innovations contradict: {'; '.join(why) or 'nothing'}", flush=True)
    listed = ", ".join(f"{k} {v:.3g}" for k, v in result.values.items() if v.ndim == 0)
    print(f"{'':20s}{time.perf_counter() - began:.0f} s; {listed}", flush=True)
    return worse


if __name__ == "__main__":
    sys.exit(main())
