"""A study as text and numbers, from which another process builds the same study and computes its chunks."""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.chunk_store import first_difference, packed, plain_identity
from trackwright.experiments.monte_carlo.declaration import Condition, Study, checked
from trackwright.experiments.monte_carlo.sources import load_study
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.user_file import split_name


class PortableStudy(NamedTuple):
    """The declaration of a study as it travels.

    `what`: the name of a study of the package, or of its file, whose `text` travels with it. `trackers`: path, as
    declared, and text of each file of users' trackers. `runs` and `seed` may be others than declared.
    """

    what: str
    text: str
    trackers: tuple[tuple[str, str], ...]
    runs: int
    seed: int

    @classmethod
    def of(cls, study: Study) -> PortableStudy:
        """The declaration of a study that was loaded by name or from a file.

        Raises UnusableInput for any other study, and for one that was changed since, except in `runs` and `seed`.
        """
        where = f"study '{study.name}'"
        if not study.declared_in:
            raise UnusableInput(
                f"{where}: was built in memory; expected one by name or from a file, which other processes can build "
                "too; write it to a file and load it with load_study"
            )
        again = _numbered(load_study(study.declared_in), study.runs, study.seed)
        difference = first_difference(plain_identity(again), plain_identity(study))
        if difference:
            raise UnusableInput(
                f"{where}: differs from its declaration {study.declared_in} ({difference}); expected the same, since "
                "other processes build it from there; write the change to the file"
            )
        names = [config.tracker for config in study.trackers.values() if isinstance(config.tracker, str)]
        files = sorted({file for file, _ in map(split_name, names) if file})
        by_file = Path(study.declared_in).suffix in (".toml", ".py")
        return cls(
            study.declared_in,
            study.source if by_file else "",
            tuple((file, Path(file).read_text("utf-8")) for file in files),
            study.runs,
            study.seed,
        )

    def study(self) -> Study:
        """The study; the files' texts stand for the files."""
        if not self.text:
            return _numbered(load_study(self.what), self.runs, self.seed)
        with tempfile.TemporaryDirectory(prefix="trackwright-") as folder:
            declared = Path(folder) / Path(self.what).name
            declared.write_text(self.text, "utf-8")
            files = {}
            for k, (file, text) in enumerate(self.trackers):
                copy = Path(folder) / f"{k}" / Path(file).name
                copy.parent.mkdir()
                copy.write_text(text, "utf-8")
                files[file] = str(copy)
            return _numbered(load_study(str(declared), files), self.runs, self.seed)


def _numbered(study: Study, runs: int, seed: int) -> Study:
    return checked(dataclasses.replace(study, runs=runs, seed=seed))


def portable_chunk(portable: PortableStudy, index: int, chunk: int) -> bytes:
    """A chunk of the condition with this index, computed in this process: the content of its file."""
    study = _study(portable)
    return packed_chunk(study, study.conditions[index], chunk)


@functools.lru_cache(maxsize=4)
def _study(portable: PortableStudy) -> Study:
    return portable.study()


def packed_chunk(study: Study, condition: Condition, chunk: int) -> bytes:
    """The content of a chunk's file."""
    return packed(timed_chunk(study, condition, chunk))


def timed_chunk(study: Study, condition: Condition, chunk: int) -> list[dict[str, np.ndarray]]:
    """The arrays of `run_chunk`, with the computing time of all trackers, s, among those of the first."""
    start, ids = time.perf_counter(), np.arange(chunk * study.chunk, (chunk + 1) * study.chunk)
    arrays = run_chunk(study, condition, ids, first=chunk == 0)
    arrays[0]["seconds"] = np.array(time.perf_counter() - start)
    return arrays
