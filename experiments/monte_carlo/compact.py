"""The arrays of a chunk as its file holds them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def compact(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk as files hold them: histograms as the distances of their cells and the counts, in few bits.

    Equal histograms are there once, under the names of all their kinds. All sums are one array.
    """
    found = {name: x for name, x in arrays.items() if not name.startswith(("cells ", "counts ", "sum ", "largest "))}
    columns = [name for name in arrays if name.startswith(("sum ", "largest "))]
    if columns:
        found |= {"columns": np.array(columns), "sums": np.stack([arrays[name] for name in columns], axis=-1)}
    alike: list[tuple[list[str], tuple[np.ndarray, np.ndarray]]] = []
    for kind in (name.partition(" ")[2] for name in arrays if name.startswith("cells ")):
        mine = arrays[f"cells {kind}"], arrays[f"counts {kind}"]
        if alike and all(map(np.array_equal, mine, alike[-1][1])):
            alike[-1][0].append(kind)
        else:
            alike.append(([kind], mine))
    for kinds, (cells, counts) in alike:
        both = np.stack([np.diff(cells, prepend=0), counts])
        found[f"histograms {' '.join(kinds)}"] = both.astype(np.min_scalar_type(both.max(initial=0)))
    return found


def expanded(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of a chunk from those of its file."""
    found: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        what, *kinds = name.split(" ")
        if what == "histograms":
            cells = np.cumsum(values[0], dtype=np.int64)
            found |= {f"{one} {kind}": x for kind in kinds for one, x in (("cells", cells), ("counts", values[1]))}
        elif what == "sums":
            found |= dict(zip(arrays["columns"].tolist(), values.T, strict=True))
        elif what != "columns":
            found[name] = values
    return found
