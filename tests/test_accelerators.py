"""The programs of trackers lower for CUDA without a GPU: no calls of the host, no matrix products in ten bits."""

from __future__ import annotations

import re

import equinox as eqx
import jax
import pytest

from tests.catalogue import CASES
from trackwright.trackers.core.data.recording import stack
from trackwright.trackers.core.run.tracker import filter_batch
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import select_parameters
from trackwright.tuning.problem import Problem, sums_with_derivatives

pytestmark = pytest.mark.slow

DEVICE_CALLS = {"LayoutConstraint", "cu_threefry2x32_ffi"}
"""Custom calls that XLA compiles for a GPU: the order of axes in memory, and jax's random bits."""


def _checked_calls(function, *arguments):
    """Targets of the custom calls in the program of `function` for CUDA, whose matrix products are in full precision."""
    dynamic, static = eqx.partition(arguments, eqx.is_array_like)
    program = jax.jit(lambda dynamic: function(*eqx.combine(dynamic, static)))
    # jax does not promise that later versions of XLA read a LayoutConstraint; this program is not stored.
    allowed = [jax.export.DisabledSafetyCheck.custom_call("LayoutConstraint")]
    exported = jax.export.export(program, platforms=["cuda"], disabled_checks=allowed)(dynamic)
    program = exported.mlir_module()
    products = [line for line in program.splitlines() if "stablehlo.dot" in line]
    assert not [line for line in products if "HIGHEST" not in line]
    return set(re.findall(r"custom_call @(\w+)", program))


@pytest.mark.parametrize("name", CASES)
def test_a_tracker_lowers_for_cuda_without_calls_of_the_host_in_full_precision(name):
    case = CASES[name]
    assert _checked_calls(filter_batch, case.tracker(), stack(case.recordings())) <= DEVICE_CALLS


@pytest.mark.parametrize("name", ["beam", "particles"])
def test_an_objective_and_its_gradient_lower_for_cuda(name):
    case = CASES[name]
    tracker, batch = case.tracker(), stack(case.recordings())
    parameters = select_parameters(tracker, ("sensors.*.sigma*",))
    problem = Problem(tracker, [batch], NegativeLogLikelihood(), parameters)
    calls = _checked_calls(sums_with_derivatives, problem.start, problem.chunks[0])
    assert calls <= DEVICE_CALLS
