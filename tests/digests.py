"""Whether a change moves numbers: `python -m tests.digests [REV]`, REV by default the commit before.

At REV and in the working tree alike it runs each tracker of `tests/catalogue.py` (estimates, NIS, log-likelihood and its
derivatives) for few trajectories and for many, three studies, and `track` on every recording in
TRACKWRIGHT_RECORDINGS, and prints what differs by a bit, with the largest relative difference. Exit code 1 where
something does. Bits depend on the processor and on jaxlib, so both sides are computed here; those of a commit are kept
in out/digests. A change that only moves code must not move a bit.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from trackwright.experiments.cli.console import keep_programs
from trackwright.experiments.lab.runner import recordings_folder, required_recordings

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "out" / "digests"
COPIES = 3  # of each trajectory of a case, so that many have the form of many

TUNED = 2  # how many numbers of a tracker are differentiated for

STUDIES = {
    "agv": ("rows = 60", ["fix-kf", "imm", "median"]),
    "ranges": ("rows = 60", ["uwb", "multilateration"]),
    "line": ("", ["line-pf"]),
}
"""Parameters of the world of this name, and the trackers of its study."""

WORKERS = 2


def main() -> int:
    """Compare the working tree with a commit; exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("base", nargs="?", default="HEAD~1", help="the commit to compare with (default: HEAD~1)")
    parser.add_argument("--only", default="*", help="subjects that match this pattern, such as 'case, uwb*'")
    parser.add_argument("--write", type=Path, help="only write the numbers of this tree to a folder")
    asked = parser.parse_args()
    # Both sides share compiled programs, most of whose bits no change of the code moves.
    os.environ.setdefault("TRACKWRIGHT_CACHE", str(KEPT.parent / "digest-programs"))
    if asked.write is not None:
        write(asked.write, asked.only)
        return 0
    before = of_commit(asked.base, asked.only)
    with tempfile.TemporaryDirectory() as folder:
        after = Path(folder)
        write(after, asked.only)
        compared = sorted({p.name for side in (before, after) for p in side.iterdir() if _asked(p.stem, asked.only)})
        moved = [line for name in compared for line in differences(before / name, after / name)]
    print("\n".join(moved) or f"no bit differs from {asked.base} in {len(compared)} subjects")
    return bool(moved)


def _asked(subject: str, only: str) -> bool:
    return fnmatch.fnmatchcase(subject, only)


def of_commit(revision: str, only: str) -> Path:
    """The folder with the numbers of a commit; those that are not kept are computed in a work tree of its own."""
    commit = subprocess.check_output(["git", "rev-parse", f"{revision}^{{commit}}"], cwd=ROOT, text=True).strip()
    kept = KEPT / commit
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder, "tree")
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree, commit], cwd=ROOT, check=True)
        try:
            real = recordings_folder()
            recordings = {} if real is None else {"TRACKWRIGHT_RECORDINGS": str(real.resolve())}
            there = {**os.environ, "PYTHONPATH": str(tree), **recordings}
            command = [sys.executable, "-m", "tests.digests", "--write", kept, "--only", only]
            subprocess.run(command, cwd=tree, env=there, check=True)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)
    return kept


def write(folder: Path, only: str) -> None:
    """Write the numbers of this tree, a file for each subject that the folder lacks."""
    from tests.catalogue import CASES
    from trackwright.trackers.recordings.files import atomic_write

    folder.mkdir(parents=True, exist_ok=True)
    # Long ones first. A new process for every few subjects: compiled programs take many memory maps.
    real = recordings_folder()
    subjects = {
        "study": [*STUDIES],
        "recording": [] if real is None else sorted(path.parent.name for path in real.glob("*/rig.toml")),
        "case": [*CASES],
    }
    jobs = [(kind, name) for kind, names in subjects.items() for name in names]
    names = {job: ", ".join(job) for job in jobs}
    jobs = [j for j in jobs if _asked(names[j], only) and not (folder / f"{names[j]}.npz").exists()]
    # A ProcessPoolExecutor hangs when all its workers are replaced (CPython issue 115634); a Pool does not.
    with get_context("spawn").Pool(WORKERS, maxtasksperchild=8) as pool:
        for count, (job, arrays) in enumerate(pool.imap_unordered(_made, jobs), 1):
            atomic_write(folder / f"{names[job]}.npz", partial(_save, arrays))
            print(f"{count} of {len(jobs)}: {names[job]}", file=sys.stderr, flush=True)


def _made(job: tuple[str, str]) -> tuple[tuple[str, str], dict[str, np.ndarray]]:
    return job, subject(*job)


def _save(arrays: dict[str, np.ndarray], path: Path) -> None:
    with path.open("wb") as file:
        np.savez(file, **arrays)


def subject(kind: str, name: str) -> dict[str, np.ndarray]:
    """The arrays of one subject by name."""
    keep_programs()
    return {"case": of_case, "study": of_study, "recording": of_recording}[kind](name)


def of_case(name: str) -> dict[str, np.ndarray]:
    """Estimates and derivatives of a case of the catalogue."""
    from tests.catalogue import CASES

    case = CASES[name]
    few = case.recordings()
    many = [replace(r, id=k) for k, r in enumerate(few * COPIES)]
    return {
        f"{form}, {what}": np.asarray(values)
        for form, batch in (("few", few), ("many", many))
        for what, values in _numbers(case.tracker(), batch)
    }


def _numbers(tracker: Any, batch: list[Any]) -> Iterator[tuple[str, Any]]:
    import jax

    from trackwright.trackers.core.data.recording import stack
    from trackwright.trackers.core.model.tunable import tunables
    from trackwright.tuning.objectives import NegativeLogLikelihood
    from trackwright.tuning.parameters import flatten, select_parameters
    from trackwright.tuning.problem import Problem

    estimates = tracker.run(batch)
    for field in ("mean", "cov_upper", "log_likelihood", "nis", "nis_dof", "wrapped", "status"):
        leaves = jax.tree_util.tree_leaves([getattr(part, field) for part in estimates])
        yield field, np.concatenate([np.ravel(x).astype(float) for x in leaves]) if leaves else np.zeros(0)
    tuned = sorted(tunables(tracker))[:TUNED]
    if tuned and np.any(np.isfinite(estimates[0].log_likelihood)):
        parameters = select_parameters(tracker, tuple(tuned))
        evaluation = Problem(tracker, [stack(batch)], NegativeLogLikelihood(), parameters).evaluate(flatten(parameters))
        yield "objective", evaluation.terms
        yield "gradient", evaluation.term_gradients


def of_study(name: str) -> dict[str, np.ndarray]:
    """The results of a study of `STUDIES`, but for its times."""
    parameters, trackers = STUDIES[name]
    with tempfile.TemporaryDirectory() as folder:
        declared = Path(folder, "study.toml")
        text = [f'name = "{name}"', 'about = "digests"', "runs = 24", f'[worlds.one]\nkind = "{name}"', parameters]
        declared.write_text("\n".join([*text, *(f"[trackers.{t}]" for t in trackers)]))
        _run("study", declared, "--out", Path(folder, "out"), "--figures", "none")
        results = json.loads(Path(folder, "out", "results.json").read_text())
    return {
        f"{cell['tracker']}, {metric}": np.array([x if x is not None else np.nan for x in figures.values()], float)
        for cell in results["cells"]
        for metric, figures in cell["figures"].items()
        if metric != "us_per_row"
    }


def of_recording(name: str) -> dict[str, np.ndarray]:
    """The columns of the tracks that `track` writes of a recording."""
    import polars as pl

    with tempfile.TemporaryDirectory() as folder:
        _run("track", required_recordings() / name, "--out", Path(folder, "out"), "--figures", "none")
        tracks = pl.read_parquet(Path(folder, "out", "tracks.parquet"))
    columns = {c.name: c.to_numpy() for c in tracks}
    return {name: x if x.dtype != object else x.astype(str) for name, x in columns.items()}


def _run(*arguments: Any) -> None:
    """Run a command of this tree; its output in the error that it raises."""
    done = subprocess.run([sys.executable, "-m", "trackwright", *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"trackwright {' '.join(map(str, arguments))}: {done.stdout[-500:]}{done.stderr[-2000:]}")


def differences(before: Path, after: Path) -> Iterator[str]:
    """A line for each array of a subject's files that is on one side alone or differs by a bit."""
    sides = [dict(np.load(path)) if path.exists() else {} for path in (before, after)]
    for name in sorted(sides[0] | sides[1]):
        line = _difference(*(side.get(name) for side in sides))
        if line:
            yield f"{before.stem}: {name}: {line}"


def _difference(before: np.ndarray | None, after: np.ndarray | None) -> str:
    if before is None or after is None:
        return "is new" if before is None else "is gone"
    if before.shape != after.shape:
        return f"shape {before.shape} became {after.shape}"
    if before.tobytes() == after.tobytes():
        return ""
    if before.dtype != after.dtype or before.dtype.kind not in "fiu":
        return f"{np.sum(before != after)} of {before.size} differ"
    raw = [np.ascontiguousarray(x).view(np.uint8).reshape(x.size, -1) for x in (before, after)]
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.abs(after.astype(float) - before) / np.maximum(np.abs(before), np.abs(after))
    relative[np.isnan(before) != np.isnan(after)] = np.inf
    largest = np.nan_to_num(relative, nan=0.0, posinf=np.inf).max(initial=0.0)
    return f"{np.sum((raw[0] != raw[1]).any(axis=1))} of {before.size} differ, by at most {largest:.1e} relative"


if __name__ == "__main__":
    sys.exit(main())
