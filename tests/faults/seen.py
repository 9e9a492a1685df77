"""What was seen of a fault that was made on purpose."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.jobs import Ended, Job, half_written, temporary


class UntriedError(Exception):
    """A fault that cannot be made on this machine, and why."""


@dataclass
class Seen:
    """How often a fault was made, and what was wrong afterwards.

    `lost`: finished parts that were computed again; `half`: half-written files; `left`: temporary files that outlived
    the next command; `compared`, `differ`: results, and those of other bits; `said`: the refusals; `wrong`: the rest.
    """

    times: int = 0
    lost: int = 0
    half: int = 0
    left: int = 0
    compared: int = 0
    differ: int = 0
    said: set[str] = field(default_factory=set)
    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __add__(self, other: Seen) -> Seen:
        return Seen(**{name: _sum(value, getattr(other, name)) for name, value in vars(self).items()})

    @property
    def faults(self) -> list[str]:
        """Everything that must not be, in words; also a fault that was never made, or that nothing was compared after."""
        counts = {
            "finished parts lost": self.lost,
            "half-written files": self.half,
            "temporary files left": self.left,
            "results of other bits": self.differ,
            "never tried": not self.times,
            "nothing compared": not self.compared,
        }
        return [*self.wrong, *(f"{name}: {int(count)}" for name, count in counts.items() if count)]

    def look(self, job: Job, out: Path, before: set) -> set:
        """Counts half-written files, and what is lost of the parts finished `before`; returns those finished now."""
        self.half += len(half_written(out))
        now = job.finished(out)
        self.lost += len(before - now)
        return now

    def compare(self, job: Job, out: Path, digest: str, ended: Ended, alone: bool = True) -> None:
        """Counts the results of a command that must have succeeded, and what it left, if it was `alone`."""
        if ended.code != 0:
            self.wrong.append(f"{job.name} ended with {ended.code}: {ended.err[-300:]}")
            return
        self.compared += 1
        self.differ += job.digest(out) != digest
        self.left += len(temporary(out)) if alone else 0
        self.half += len(half_written(out))

    def refused(self, ended: Ended, place: Path, code: int = 2, *words: str) -> None:
        """Notes a refusal, which must have this exit code, be one line, and have these words."""
        lines = [line for line in ended.err.splitlines() if line.startswith("trackwright: ")]
        if ended.code != code or ended.err.splitlines()[-1:] != lines or "Traceback" in ended.err:
            self.wrong.append(f"not refused in a line: {ended.code}, {ended.err[-500:]}")
            return
        line = lines[0].removeprefix("trackwright: ").replace(f"{place}/", "")
        line = re.sub(r"tcp://[\d.]+:\d+", "tcp://…", line)
        self.wrong += [f"lacks {word!r}: {line}" for word in words if word not in line]
        self.said.add(line)


def _sum(one: object, other: object) -> object:
    return one | other if isinstance(one, set) else one + other  # type: ignore[operator]
