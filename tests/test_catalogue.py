"""The catalogue of the tests is complete: a class of the library without a case fails here by its name."""

import contextlib
import dataclasses
import importlib
import inspect
import pkgutil
from collections.abc import Mapping

import equinox as eqx
import pytest

from tests.catalogue import CASES, MOTIONS, SENSORS
from trackwright import trackers
from trackwright.trackers.catalogue import TRACKERS
from trackwright.trackers.core.filters.filter import AbstractFilter, AbstractStart
from trackwright.trackers.core.filters.particle.filter import AbstractOutputMap, AbstractPotential
from trackwright.trackers.core.model.motion import AbstractMotion
from trackwright.trackers.core.model.sensor import AbstractSensor
from trackwright.trackers.core.run.smoother import Smoothed
from trackwright.trackers.core.run.tracker import AbstractTracker


def _modules():
    """The `eqx.Module`s of the library by their full names."""
    modules = {}
    for module in pkgutil.walk_packages(trackers.__path__, "trackwright.trackers."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if isinstance(value, type) and issubclass(value, eqx.Module) and value.__module__ == module.name:
                modules[f"{module.name}.{name}"] = value
    return modules


LIBRARY = _modules()


def _parts(node):
    """The classes of all modules in a tree of modules, mappings and sequences."""
    if isinstance(node, eqx.Module):
        yield type(node)
        for field in dataclasses.fields(node):
            yield from _parts(getattr(node, field.name))
    elif isinstance(node, Mapping):
        for value in node.values():
            yield from _parts(value)
    elif isinstance(node, (tuple, list)):
        for value in node:
            yield from _parts(value)


@pytest.fixture(scope="module")
def in_cases():
    return {kind for case in CASES.values() for kind in _parts(case.tracker())}


def _concrete(base):
    return {name: kind for name, kind in LIBRARY.items() if issubclass(kind, base) and not inspect.isabstract(kind)}


@pytest.mark.parametrize(
    "base",
    [
        AbstractTracker,
        AbstractFilter,
        AbstractStart,
        AbstractPotential,
        AbstractOutputMap,
        AbstractMotion,
        AbstractSensor,
    ],
)
def test_every_concrete_class_is_part_of_a_tracker_of_the_catalogue(base, in_cases):
    assert [name for name, kind in _concrete(base).items() if kind not in in_cases] == []


@pytest.mark.parametrize(("base", "cases"), [(AbstractMotion, MOTIONS), (AbstractSensor, SENSORS)])
def test_every_motion_and_sensor_has_a_contract(base, cases):
    parts = {type(getattr(case, "motion", None) or case.sensor) for case in cases.values()}
    assert [name for name, kind in _concrete(base).items() if kind not in parts] == []


def test_every_ready_tracker_has_a_case():
    assert set(TRACKERS) == {case.reads for case in CASES.values() if case.build is None}


def test_a_case_can_be_smoothed_where_it_says_so():
    for case in CASES.values():
        if case.causal:
            with contextlib.nullcontext() if case.smoothable else pytest.raises(TypeError, match="Kalman filters"):
                Smoothed(case.tracker())
