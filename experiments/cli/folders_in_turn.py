"""Recordings that are read one at a time, as often as they are needed, where their tables have no room in memory."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from experiments.cli.console import ReadingOptions, ready
from experiments.text.terminal import notice
from trackers.recordings.folder import RecordingFolder, read_recording, refuse_repeated


class FoldersInTurn(Sequence[RecordingFolder]):
    """Recordings that are read whenever they are asked for, and kept by nobody here; notices are printed once."""

    def __init__(self, paths: Sequence[Path], used: ReadingOptions) -> None:
        refuse_repeated(paths)
        self.paths, self.used, self.numbers = paths, used, dict[str, int]()
        self.calibration = used.read_calibration()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[k] for k in range(len(self))[which]]
        number = range(len(self))[which]
        folder, lines = ready(read_recording(self.paths[number]), self.used, self.calibration)
        for line in () if number in self.numbers.values() else lines:
            notice(f"notice: {line}")
        self.numbers[folder.name] = number
        return folder

    def named(self, names: Iterable[str]) -> list[RecordingFolder]:
        """The recordings of these names, which were read before."""
        return [self[self.numbers[name]] for name in names]
