"""Checkpoints of fits: the arrays of a state and the fit's fingerprint in one file, written atomically."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import jax
import numpy as np

from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.run.chunks import CHUNK, pieces
from trackwright.trackers.recordings.files import atomic_write, config_hash, read_arrays
from trackwright.tuning.optimisation import AbstractOptimiser, FitState

CHECKPOINT = "checkpoint.npz"
FORMAT = 2  # of the arrays of a state; a checkpoint of another format is refused


def to_arrays(state: FitState) -> list[np.ndarray]:
    """The arrays of a state, for a file."""
    return [np.asarray(leaf) for leaf in jax.tree_util.tree_leaves(state)]


def from_arrays(optimiser: AbstractOptimiser, arrays: Sequence[np.ndarray]) -> FitState:
    """The state of a fit with this optimiser from the arrays of `to_arrays`.

    Raises UnusableInput where there are more or fewer.
    """
    if len(arrays) < 2:
        raise UnusableInput(f"{CHECKPOINT}: holds {len(arrays)} arrays, no state of a fit; remove it, or begin anew")
    number, vectors = arrays[:2]
    template = FitState(*[number] * len(FitState._fields))._replace(optimiser_state=optimiser.init(vectors))
    leaves, structure = jax.tree_util.tree_flatten(template)
    if len(leaves) != len(arrays):
        raise UnusableInput(
            f"{CHECKPOINT}: holds {len(arrays)} arrays, expected {len(leaves)} with this optimiser; remove it, or "
            "begin anew"
        )
    return FitState(*jax.tree_util.tree_unflatten(structure, list(arrays)))


def fingerprint(config: Mapping[str, Any], batches: Sequence[Batch], start: np.ndarray) -> str:
    """A hash of the options of a fit, of all numbers of its recordings, and of its starting values."""
    digest = hashlib.sha256(f"{FORMAT} {config_hash(config)}".encode())
    parts = (part for batch in batches for part in pieces(batch, CHUNK))
    for leaf in chain([start], *map(jax.tree_util.tree_leaves, parts)):
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
    return digest.hexdigest()


def save(folder: Path, arrays: Sequence[np.ndarray], belongs_to: str) -> Path:
    """Write the arrays of a state to the folder's checkpoint; `belongs_to`: the fingerprint."""
    numbered: dict[str, Any] = {f"array_{k}": x for k, x in enumerate(arrays)}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, belongs_to=np.array(belongs_to), **numbered)

    return atomic_write(folder / CHECKPOINT, write)


def load(folder: Path, belongs_to: str) -> list[np.ndarray] | None:
    """The arrays of the folder's checkpoint, None without one.

    Raises UnusableInput for a checkpoint of another fit, and for a file that is no checkpoint.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        stored = read_arrays(path)
        owner = str(stored["belongs_to"])
        arrays = [stored[f"array_{k}"] for k in range(len(stored) - 1)]
    except (ValueError, KeyError) as error:
        raise UnusableInput(f"{path}: is no checkpoint of `tune`; remove it, or begin anew") from error
    if owner != belongs_to:
        raise UnusableInput(
            f"{path}: belongs to a fit with other options, recordings, starting values or version; expected the "
            "command that wrote it (see its manifest), or a fit that begins anew"
        )
    return arrays
