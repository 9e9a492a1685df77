"""`trackwright track`."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import tyro

from experiments.cli.console import notice, output_folder, progress, read_with_notices
from experiments.cli.evaluate import SOURCES
from experiments.cli.manifest import write_manifest
from experiments.executors import cluster_executor
from experiments.plots.track_folder import plot_tracks
from experiments.portable_tracker import run_on
from experiments.reports.evaluation_text import to_text
from trackers.catalogue import TRACKERS, build, fitting
from trackers.core.chunks import CHUNK
from trackers.core.errors import UnusableInput
from trackers.evaluation import evaluate
from trackers.events import EVENTS, events_of
from trackers.recordings.association import associate_truth
from trackers.recordings.atomic import atomic_write
from trackers.recordings.tracks import track as run
from trackers.recordings.tracks_table import TRACKS
from trackers.recordings.trajectories import known_height
from tuning.tuned_file import read_tuned


def track(  # noqa: D103
    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path,
    tracker: str | None = None,
    noise: Path | None = None,
    free_height: bool = False,
    smooth: bool = False,
    lag: float | None = None,
    seed: int = 0,
    cluster: str | None = None,
) -> int:
    started = datetime.now(UTC)
    folders = read_with_notices(recordings)
    name = tracker or fitting(folders[0])
    named = build(name, folders, free_height)
    if tracker is None:
        notice(f"tracker: {name} ({named.spec.about}); choose another with --tracker")
    if noise is not None:
        named = named.with_values(read_tuned(noise), noise)
    if smooth or lag is not None:
        named = named.smoothing(lag)
    batches = named.batches(folders)
    flat = [trajectory for batch in batches if batch.planar for trajectory in batch.trajectories]
    heights = sum(known_height(trajectory.folder, trajectory.tag) is not None for trajectory in flat)
    if heights and not named.spec.bearing_only:
        notice(f"height: known from rig.toml for {heights} tag(s) and used; estimate it with --free-height")
    output_folder(out)
    with (
        cluster_executor(cluster) if cluster else nullcontext() as executor,
        progress("tracking", sum(len(batch.trajectories) for batch in batches)) as advance,
    ):
        tracks = run(batches, advance, seed) if executor is None else run_on(executor, named, folders, advance, seed)
    table, summaries = tracks.table, tracks.summaries
    atomic_write(out / TRACKS, table.write_parquet)
    happened = events_of(table, named.spec, batches)
    atomic_write(out / EVENTS, happened.write_parquet)
    paths = "\n".join(str(p.resolve()) for p in recordings)
    atomic_write(out / SOURCES, lambda path: path.write_text(paths + "\n", encoding="utf-8"))
    print(
        f"{sum(summaries.values())} tracks: "
        + "; ".join(f"{n} {v}" for v, n in sorted(summaries.items(), key=lambda x: -x[1]))
    )
    truths = {f.name: f.tables["truth"] for f in folders if "truth" in f.tables}
    association = associate_truth(table, truths)
    if truths:
        try:
            print(to_text(evaluate(association, folders)), end="")
        except UnusableInput as problem:
            notice(f"notice: not evaluated: {problem}")
    drawn = plot_tracks(out, association, folders, batches)
    config = {
        "tracker": name,
        "noise": None if noise is None else str(noise),
        "free_height": free_height,
        "smooth": smooth,
        "lag": lag,
        "seed": seed,
    }
    write_manifest(
        out,
        sys.argv,
        config,
        started,
        chunk=CHUNK,
        extra={"recordings": [str(p) for p in recordings], "verdicts": summaries},
    )
    for event, count in happened.group_by("event", maintain_order=True).len().iter_rows():
        print(f"event: {event} ({count} times)")
    written = f"{out / TRACKS} ({len(table)} estimates), {EVENTS}, manifest.json"
    print(f"wrote {written} and {len(drawn)} figures: {', '.join(drawn)}")
    return 0


_LIST = "\n".join(f"    {name}: {entry.about} ({entry.table})" for name, entry in TRACKERS.items())
track.__doc__ = f"""Track recordings: writes tracks.parquet, events.parquet, figures and manifest.json.

Trackers (and the table they read):
{_LIST}

Args:
    recordings: recording folders (rig.toml and tables).
    out: the folder to write to.
    tracker: one of the names above, or FILE.py:NAME of a TrackerSpec of your own; default: what fits the tables.
    noise: a tuned.toml of `trackwright tune`.
    free_height: estimate the height of tags whose height the rig gives.
    smooth: use the rows after each row too, all of them: for recordings, where nothing has to be known at once.
    lag: smooth with the rows of the next so many seconds only.
    seed: of the random numbers of particle filters; another one gives other estimates of the same distribution.
    cluster: track each recording by itself on a Dask cluster, tcp://HOST:8786, or in processes here, local:4.
"""
