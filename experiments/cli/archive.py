"""`track` on an archive: recordings one by one, finished ones kept, one table of results.

A finished recording is a run folder for each tracker, and a file beside them, written last, that says what it depends
on: options, trackers, versions, and the content of the recording.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import polars as pl

import trackwright as tw
from trackwright.experiments.cli import tracking as runs
from trackwright.experiments.cli.console import LEFT_OUT, output_folder, ready
from trackwright.experiments.cli.options import TrackOptions
from trackwright.experiments.jobs.executors import Threads, cluster_executor, environment
from trackwright.experiments.jobs.store import Store
from trackwright.experiments.jobs.store import run as run_parts
from trackwright.experiments.text.tables import archive_text, content, terminal_width, to_json
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.catalogue import fitting, run_files, spec_of
from trackwright.trackers.core.errors import has_control, one_line
from trackwright.trackers.core.user_file import split_name
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.metrics import added, metrics, sums
from trackwright.trackers.recordings.atomic import Content, atomic_write, config_hash, json_text, write_whole
from trackwright.trackers.recordings.folder import content_of
from trackwright.trackers.recordings.rig_file import RIG_FILE, read_rig
from trackwright.trackers.recordings.tracks_table import EVALUATION, RECORDINGS, RESULTS, SOURCES, TRACKS, sources_text

FINISHED, ERRORS = "tracked.json", "tracked.parquet"
"""The file written last for a recording, and its errors, which the percentiles of all are taken from."""

NAMES, TEXTS = ("recording", "path", "tracker", "tracks", "endings"), ("notices", "refused")
"""The columns of the table of results before and after the metrics."""

LISTED = 20  # the most refusals that are printed; the table of results has all
Summary = dict[str, Any]
"""What one tracker found in one recording, in plain values."""


@dataclass(frozen=True)
class Result:
    """What was found in one recording: summaries, a line for each refusal, notices; files by place below its folder."""

    outcomes: list[Summary] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    files: dict[str, Content] = field(default_factory=dict)


@dataclass(frozen=True)
class Archive(Store[Path, Result]):
    """How recordings are tracked, wherever that is, and the finished ones in the output folder. `names`: of the
    trackers, none for the one that fits each recording. `renamed`: names of recordings."""

    options: TrackOptions
    names: Sequence[str]
    renamed: Mapping[Path, str]
    out: Path

    @cached_property
    def calibration(self) -> tw.Calibration | None:
        """The calibration of all recordings."""
        return self.options.used.read_calibration()

    def part(self, path: Path) -> Result:
        """What is found in the recording at `path`; raises UnusableInput where it has errors."""
        run_files(self.options.named)  # a user's file may add the kind of the recording's tables
        recording = tw.read(path)
        recording = replace(recording, name=self.renamed.get(path, recording.name))
        folder, lines = ready(recording, self.options.used, self.options.force, self.calibration)
        result = Result(notices=[*map(one_line, lines)])
        for name in self.names or [fitting(folder)]:
            try:
                found, lines = runs.tracked(name, [folder], self.options, runs.silent)
            except tw.UnusableInput as problem:
                result.refused.append(_naming(path, problem))
                continue
            evaluation, rows, own = found.evaluation, found.rows, runs.short(name)
            (of_recording,) = evaluation.recordings
            summary = {"tracker": name, "short": own, "endings": found.tracks.summaries, "recording": folder.name}
            totals = sums(rows).row(0, named=True)
            parts = {"metrics": of_recording, "tracks": evaluation.tracks, "sums": totals}
            result.outcomes.append(summary | {"bearing": evaluation.bearing} | parts)
            errors = rows.filter(pl.col("why").is_null()).select("^(size_.*|nees|nees_3d)$")
            result.files.update({f"{own}/{file}": x for file, x in (runs.files_of(found) | {ERRORS: errors}).items()})
            result.notices.extend(map(one_line, lines))
        return result

    @cached_property
    def _settings(self) -> str:
        """All that the outcome of a recording depends on, beside its content."""
        options = self.options
        files = options.noise, options.used.calibration, *(split_name(name)[0] for name in self.names)
        texts = [Path(file).read_text("utf-8") for file in files if file]
        numbers = replace(options.numbers, tracker=None)
        plain = options.settings(numbers=numbers, noise=None, cluster=None, figures="page", json=False)
        return repr((plain, [*map(runs.short, self.names)], texts, environment()))

    def folder(self, path: Path) -> Path:
        """The folder of the recording at `path`: its name, and a digest of the path."""
        whole = path.resolve()
        digest = hashlib.sha256(os.fsencode(whole)).hexdigest()[:8]
        plain = re.sub(r"[^\w.-]", "_", whole.name, flags=re.ASCII)[:80]
        return self.out / RECORDINGS / f"{plain}-{digest}"

    def _digest(self, path: Path) -> str:
        return config_hash({"content": content_of(path) + self.renamed.get(path, ""), "settings": self._settings})

    def read(self, item: Path) -> Result:
        """As `Store`."""
        kept = json.loads((self.folder(item) / FINISHED).read_bytes())
        if kept.pop("digest") != self._digest(item):
            raise LookupError("of other inputs")
        for summary in kept["outcomes"]:
            for table in (TRACKS, ERRORS):
                pl.read_parquet_schema(self.folder(item) / summary["short"] / table)
        return Result(**kept)

    def files(self, item: Path, result: Result) -> dict[Path, Content]:
        """As `Store`; a recording in which nothing was found is tried again by the next run."""
        if not result.outcomes:
            return {}
        kept = asdict(replace(result, files={})) | {"digest": self._digest(item)}
        files = result.files | {FINISHED: json_text(kept)}
        return {self.folder(item) / name: rows for name, rows in files.items()}


def _names_apart(paths: Sequence[Path]) -> dict[Path, str]:
    """The paths as names of the recordings that have a name which others have, too."""
    names: dict[Path, str] = {}
    for path in paths:
        with suppress(tw.UnusableInput):
            names[path] = read_rig(path / RIG_FILE)[0].name
    counts = Counter([*names.values(), *map(str, paths)])
    return {path: str(path) for path, name in names.items() if counts[name] > 1 and name != str(path)}


def _refusal(path: Path, error: Exception) -> Result:
    """What stands for a recording that could not be used: a line that names it, so that the others go on."""
    if isinstance(error, tw.UnusableInput):
        return Result(refused=[_naming(path, error)])
    why = f"cannot be used ({type(error).__name__}: {one_line(error) or 'no message'})"
    if type(error).__name__ == "KilledWorker":
        why = "its workers ended while they computed it; expected enough memory for one recording a worker"
    return Result(refused=[f"{path}: {why}"])


def _naming(path: Path, problem: tw.UnusableInput) -> str:
    """The refusal with the path of the recording."""
    return str(problem) if one_line(path) in str(problem) else f"{path}: {problem}"


def track_archive(paths: Sequence[Path], options: TrackOptions, begin: Begin) -> tuple[int, dict[str, Any]]:
    """Tracks the recordings that are not finished, and writes the tables of all; exit code, and metrics by tracker."""
    names, renamed, found = runs.named_runs(options), _names_apart(paths), dict[Path, Result]()
    for name in names:
        spec_of(name)
    for path in [*renamed][:1]:
        notice(f"notice: {len(renamed)} recordings, as {path}, are named by their paths: others have their names")
    archive = Archive(options, names, renamed, output_folder(options.out))
    _ = archive.calibration
    advance = begin("tracking", len(paths))

    def each(path: Path, result: Result) -> None:
        found[path] = result
        advance(1)

    with cluster_executor(options.cluster) if options.cluster else Threads() as executor:
        run_parts(paths, archive.part, archive, executor, each, _refusal)
    lines = [line for path in paths for line in found[path].refused]
    if not any(result.outcomes for result in found.values()):
        _list_refused(lines[1:], "")
        raise tw.UnusableInput(lines[0])
    begin("tables")
    results = options.out / RESULTS
    atomic_write(results, _results([(path, found[path]) for path in paths]).write_csv)
    by_tracker: dict[str, list[tuple[Path, Summary]]] = {}
    for path in paths:
        for summary in found[path].outcomes:
            by_tracker.setdefault(summary["short"], []).append((path, summary))
    shown = {}
    for name, of in by_tracker.items():
        out = options.out if len(by_tracker) == 1 else output_folder(options.out / name)
        shown[name] = _write_run(name, sorted(of, key=lambda one: str(one[1]["recording"])), out, archive)
    print(f"wrote {results}, a row for each recording and tracker")
    if noticed := sum(bool(result.notices and result.outcomes) for result in found.values()):
        notice(f"notice: {counted(noticed, 'recording')} with notices: column 'notices' of {results}")
    if refused := sum(bool(result.refused) for result in found.values()):
        notice(f"not tracked: {refused} of {counted(len(paths), 'recording')}")
    _list_refused(lines, f": column 'refused' of {results}")
    return LEFT_OUT if refused else 0, shown


def _results(found: Sequence[tuple[Path, Result]]) -> pl.DataFrame:
    """The table of results."""
    rows: list[dict[str, Any]] = [dict.fromkeys((*NAMES, *TEXTS))]
    for path, result in found:
        # A name that no line can hold is shown; no command looks for it.
        whole = str(path.resolve()) if not has_control(str(path.resolve())) else one_line(path.resolve())
        for summary in result.outcomes:
            endings = summary["endings"]
            tracks = {"tracks": sum(endings.values()), "endings": "; ".join(f"{k} {n}" for k, n in endings.items())}
            names = {"path": whole, "tracker": summary["short"], "notices": "; ".join(result.notices)}
            rows.append(names | tracks | summary["metrics"])
        rows += [{"path": whole, "refused": line} for line in result.refused]
    table = pl.DataFrame(rows, infer_schema_length=None)[1:]
    return table.select(*NAMES, pl.exclude(*NAMES, *TEXTS), *TEXTS)


def _write_run(name: str, of: Sequence[tuple[Path, Summary]], out: Path, archive: Archive) -> dict[str, Any]:
    """Writes the tables of a tracker over all recordings, and prints its metrics; what evaluation.json holds."""
    summaries = [summary for _, summary in of]

    def rows(table: str) -> pl.LazyFrame:
        """The tables of all recordings as one, which is not in memory."""
        files, schema = [archive.folder(path) / name / table for path, _ in of], dict[str, Any]()
        for file in files:
            schema |= pl.read_parquet_schema(file)
        return pl.scan_parquet(files, schema=pl.Schema(schema), missing_columns="insert")

    whole = added(pl.DataFrame([x["sums"] for x in summaries], infer_schema_length=None), rows(ERRORS))
    levels = [x["metrics"] for x in summaries], [track for x in summaries for track in x["tracks"]]
    filled = [pl.DataFrame(level, infer_schema_length=None).to_dicts() for level in levels]
    evaluation = tw.Evaluation(summaries[0]["bearing"], metrics(whole).row(0, named=True), *filled)
    write_whole(out / EVALUATION, to_json(evaluation))
    write_whole(out / SOURCES, sources_text(path for path, _ in of))
    atomic_write(out / TRACKS, partial(rows(TRACKS).sink_parquet, compression_level=1))
    endings = sum((Counter(x["endings"]) for x in summaries), Counter[str]())
    print(f"{name}: {counted(len(of), 'recording')}, {runs.words_of(endings)}")
    if evaluation.overall["n"]:
        print(archive_text(evaluation, terminal_width()), end="")
    runs.conclude(evaluation, summaries[0]["tracker"], evaluation.overall["n_rows"], archive.options, out)
    return content(evaluation)


def _list_refused(lines: Sequence[str], where: str) -> None:
    """A line for each refusal, up to some; `where`: the place of all."""
    for line in lines[:LISTED]:
        notice(f"not tracked: {line}")
    if len(lines) > LISTED:
        notice(f"not tracked: {len(lines) - LISTED} more{where}")
