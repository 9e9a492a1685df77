"""The state before the first row of a run: given beliefs, or the state after the last row of an earlier run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, Shaped

from trackwright.trackers.core.data.recording import Batch, Recording
from trackwright.trackers.core.data.seconds import moment
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.covariance import Gaussian


class TrackerState(NamedTuple):
    """The state of a tracker after the last row of each recording, from which a later run continues.

    `state`: the tracker's own, trajectories first in every array. `times` (B,): s, of the last rows.
    """

    state: Any
    times: Float[np.ndarray, " B"]


def trajectories_of(state: Any, start: int, stop: int) -> Any:
    """The trajectories start … stop − 1 of a state, padded with zeros beyond its end."""

    def cut(x: Shaped[Array | np.ndarray, "B *shape"]) -> Shaped[np.ndarray, "part *shape"]:
        part = np.asarray(x)[start:stop]
        return np.pad(part, [(0, stop - start - len(part)), *[(0, 0)] * (part.ndim - 1)])

    return jax.tree_util.tree_map(cut, state)


def continued(batch: Batch, recordings: Sequence[Recording], initial: TrackerState) -> Batch:
    """The batch with the time from the last row of each earlier recording to its first row."""
    if len(initial.times) != len(recordings):
        raise UnusableInput(
            f"run: `initial` is the state after {len(initial.times)} recordings, found {len(recordings)}; expected the "
            "recordings that continue them, in their order"
        )
    gaps = np.array([r.times[0] for r in recordings]) - initial.times
    if (gaps < 0).any():
        k = int(np.argmax(gaps < 0))
        raise UnusableInput(
            f"run: '{recordings[k].name}' begins at {moment(recordings[k].times[0])}, its `initial` state is that at "
            f"{moment(initial.times[k])}; expected later rows; leave out the rows that were run before"
        )
    dt = np.array(batch.dt)
    dt[0] = gaps
    return batch._replace(dt=dt)


def stacked_priors(prior: Gaussian | Sequence[Gaussian], count: int, dtype: DTypeLike) -> Gaussian:
    """One prior for each of `count` trajectories, (B,) first in every array."""
    each = [prior] * count if isinstance(prior, Gaussian) else list(prior)
    if len(each) != count or not all(isinstance(g, Gaussian) for g in each):
        raise UnusableInput(
            f"run: `initial` holds {len(each)} beliefs for {count} recordings; expected one Gaussian for all, one for "
            "each, or the `final` of an earlier run"
        )
    found: Gaussian = jax.tree_util.tree_map(lambda *x: jnp.stack([jnp.asarray(v, dtype) for v in x]), *each)
    return found
