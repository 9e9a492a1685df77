"""Sums over the rows of a batch: by `accumulate` as by `scan`, alone as in a batch, and their derivatives."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from trackwright.trackers.conformance.contract import BrokenContract, NotApplicable
from trackwright.trackers.conformance.identities import ALONE
from trackwright.trackers.conformance.ran import Ran, draws_random_numbers
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.model.tunable import replaced, tunables
from trackwright.trackers.core.run.chunks import as_dtype, called
from trackwright.trackers.core.run.scan import Output
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch

STEP = 3e-4
"""Half the interval of a difference quotient, of the unconstrained value of a tunable."""

SMALLER_STEP = 1e-5
"""Where that quotient is not the derivative, as between corners close together; a wrong derivative is so over both."""

RESOLUTION = 1e-9
"""Relative rounding of a sum: an update of a diffuse prior loses digits to cancellation."""


class Sums:
    """Sums over all rows of log-likelihood and estimates, at the tunables of a tracker and a little off each."""

    def __init__(self, tracker: AbstractTracker, ran: Ran) -> None:
        self.ran = ran
        self.batch = stack(ran.recordings, rows=ran.rows)._replace(truth={})
        self.model = as_dtype(tracker, self.batch.dt.dtype)
        self.nodes = tunables(self.model)
        self.labels = [name for name, node in self.nodes.items() for _ in range(np.size(node.raw))]
        self.point = np.concatenate([np.ravel(np.asarray(x.raw)) for x in self.nodes.values()] or [np.zeros(0)])
        self.program = jax.jit(lambda vectors: jax.lax.map(self.sums, vectors))
        self.values = self.around(STEP)
        self.output: Output = called(filter_batch, self.model, self.batch)

    def sums(self, vector: Float[Array, " p"]) -> Float[Array, " 2"]:
        """The sums by `accumulate`, (2,), with the unconstrained values of all tunables."""
        nodes, start = {}, 0
        for name, node in self.nodes.items():
            size = np.size(node.raw)
            raw = jnp.reshape(vector[start : start + size], np.shape(node.raw))
            nodes[name], start = eqx.tree_at(lambda n: n.raw, node, raw), start + size
        return jnp.stack([jnp.sum(x) for x in replaced(self.model, nodes).accumulate(self.batch, _score)])

    def around(self, step: float) -> Float[np.ndarray, "points 2"]:
        """The sums at the tunables, then with each a step up, a step down, two up and two down."""
        shifts = step * np.eye(len(self.point))
        points = self.point + np.concatenate([np.zeros((1, len(shifts))), shifts, -shifts, 2 * shifts, -2 * shifts])
        with jax.enable_x64(True):
            return np.asarray(self.program(jnp.asarray(points)))

    def compare_sums(self) -> str:
        """Raises unless `accumulate` sums what `scan` returns."""
        with jax.enable_x64(True):
            of_scan = np.array([float(jnp.sum(x)) for x in jax.vmap(_score, in_axes=(0, None))(self.output, {})])
        for what, mine, other in zip(("log-likelihood", "estimates"), self.values[0], of_scan, strict=True):
            if not abs(mine - other) <= 1e-6 * max(abs(other), 1.0):
                raise BrokenContract(
                    f"the sum of the {what} over all rows is {mine:.8g} by `accumulate`, {other:.8g} by `scan`; usual "
                    "fix: derive from AbstractEpochwiseTracker, whose `accumulate` scores the output of `scan`"
                )
        return f"log-likelihood {of_scan[0]:.6g} by both"

    def compare_alone(self) -> str:
        """Raises unless a recording alone has the estimates that it has in a batch, to rounding."""
        with jax.enable_x64(True):
            alone = called(filter_batch, self.model, self.batch.columns(0, 1), for_few=True)
        numbers = ((x.mean, x.cov, x.log_likelihood, x.nis, x.nis_dof, x.wrapped) for x in (alone, self.output))
        pairs = zip(*map(jax.tree_util.tree_leaves, numbers), strict=True)
        apart = max(_in_roundings(np.asarray(a)[..., 0], np.asarray(b)[..., 0]) for a, b in pairs)
        if not apart <= 1.0:
            raise BrokenContract(
                f"estimates of recording 0 alone and in a batch differ by {apart:.2g} times what rounding explains, "
                f"expected the same; {ALONE}, and the same formulas for one trajectory as for many"
            )
        return "a recording alone has the numbers that it has in a batch"

    def compare_slopes(self) -> str:
        """Raises unless the derivatives by all tunables are difference quotients."""
        if not self.labels:
            raise NotApplicable("the tracker has no tunables")
        if draws_random_numbers(self.ran):
            raise NotApplicable("estimates depend on random numbers, whose derivative is no difference quotient")
        with jax.enable_x64(True):
            slopes = np.asarray(jax.jit(jax.jacfwd(self.sums))(jnp.asarray(self.point)))
        here = self.values[0]
        up, down, far_up, far_down = np.split(self.values[1:].T, 4, axis=1)
        numeric = (up - down) / (2 * STEP)
        noise = RESOLUTION * np.maximum(np.abs(here), 1.0)[:, None] / STEP
        # Of a smooth function the slopes on both sides differ twice as much over twice the interval.
        bends = ((far_up + far_down - 2 * here[:, None]) / 2 - 2 * (up + down - 2 * here[:, None])) / STEP
        corner = np.abs(bends) > 0.01 * np.abs(numeric) + noise
        wrong = (np.abs(slopes - numeric) > 1e-3 * np.abs(numeric) + noise) & ~corner
        if wrong.any():
            up, down, _, _ = np.split(self.around(SMALLER_STEP)[1:].T, 4, axis=1)
            nearer = (up - down) / (2 * SMALLER_STEP)
            wrong &= np.abs(slopes - nearer) > 1e-3 * np.abs(nearer) + noise
        if wrong.any() or not np.isfinite(slopes).all():
            figure, k = np.argwhere(wrong | ~np.isfinite(slopes))[0]
            raise BrokenContract(
                f"the derivative of the {('log-likelihood', 'estimates')[figure]} by {self.labels[k]} is "
                f"{slopes[figure, k]:.6g}, by difference quotients {numeric[figure, k]:.6g}; usual fix: no "
                "stop_gradient, rounding or NumPy on its way, and smooth = True for a start that reads it"
            )
        at_corner = sorted({self.labels[k] for k in np.argwhere(corner)[:, 1]})
        return f"{len(self.point)} tunables" + (
            f"; at a corner, and left out: {', '.join(at_corner)}" if at_corner else ""
        )


def _score(output: Output, truth: Any) -> tuple[Any, Any]:
    """The log-likelihood of each trajectory in a row, and a sum of its estimate's numbers with weights near one."""
    numbers = [x.reshape(-1, x.shape[-1]) for x in jax.tree_util.tree_leaves(output.mean)]
    each = jnp.concatenate([x.astype(output.log_likelihood.dtype) for x in numbers])
    weights = 1.0 + 0.1 * np.cos(np.arange(len(each)))
    return output.log_likelihood, jnp.sum(jnp.asarray(weights, each.dtype)[:, None] * each, axis=0)


def _in_roundings(a: np.ndarray, b: np.ndarray) -> float:
    """The largest difference in units of what rounding explains in double precision."""
    with np.errstate(invalid="ignore"):
        apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    return float(np.max(apart / (1e-9 + 1e-7 * np.abs(b)), initial=0.0))
