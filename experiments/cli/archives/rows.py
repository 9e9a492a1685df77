"""Rows of named values held as columns, in a fraction of the memory of dictionaries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl

BLOCK = 256
"""Rows that are held as dictionaries before they become columns."""


class Rows(Sequence[dict[str, Any]]):
    """Rows that are appended one by one; a value that a row lacks is None."""

    def __init__(self, frame: pl.DataFrame | None = None) -> None:
        self._blocks = [] if frame is None else [frame]
        self._latest: list[Mapping[str, Any]] = []

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds a row."""
        self._latest.append(row)
        if len(self._latest) == BLOCK:
            self._pack()

    def _pack(self) -> None:
        self._blocks.append(pl.DataFrame(self._latest, infer_schema_length=None))
        self._latest = []

    @property
    def frame(self) -> pl.DataFrame:
        """All rows as a table."""
        if self._latest or not self._blocks:
            self._pack()
        if len(self._blocks) > 1:
            self._blocks = [pl.concat(self._blocks, how="diagonal_relaxed", rechunk=True)]
        return self._blocks[0]

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: Any) -> Any:
        return self.frame[index].to_dicts() if isinstance(index, slice) else self.frame.row(index, named=True)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return self.frame.iter_rows(named=True)
