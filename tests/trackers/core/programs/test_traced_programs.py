"""Programs that are found without tracing: the bits of those that are traced, and none where a key could be wrong."""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from trackwright.sim import worlds
from trackwright.trackers.catalogue import TRACKERS, build
from trackwright.trackers.core.programs import PREFIX, USERS_FILE, ProgramStore
from trackwright.trackers.core.run.chunks import OPTIONS, as_dtype, chunks, jitted, outputs, outputs_and_state
from trackwright.trackers.recordings.tracks import batches

pytestmark = pytest.mark.slow

WORLDS = {"phases": worlds.station, "ranges": worlds.ranges, "imu": worlds.tool, "fixes": worlds.agv}
SLOW = ("uwb", "direct", "cascade", "das", "uwb-imu", "imm", "mhk", "floor-pf", "line-pf", "line-grid")


def _case(name):
    """The arguments of a small run of a tracker of the catalogue on the first world that has what it reads."""
    for world in (*WORLDS.values(), worlds.line):
        # The number of a line's rows follows from its length and speed.
        rows = {} if world is worlds.line else {"rows": 16}
        folder = world(n=2, seed=3, **rows).folder()
        if TRACKERS[name].missing(folder) is None:
            group = build(name, folder).batches(folder)[0]
            batch = batches(group.trajectories)[0][1]
            return (as_dtype(group.tracker, batch.dt.dtype), None), next(chunks(batch, 2))
    pytest.skip("no world has what it reads")


@pytest.fixture(scope="module")
def fixes():
    return _case("fix-kf")


@pytest.fixture
def compiled_anew():
    """Without a cache of jax's own, as JAX_COMPILATION_CACHE_DIR sets: XLA loses functions of what it loads."""
    compilation_cache.reset_cache()
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()


@pytest.fixture
def store(tmp_path, monkeypatch, compiled_anew):
    # Files of users that other tests imported in this process keep all programs from being found.
    for name in [name for name in sys.modules if name.startswith(USERS_FILE)]:
        monkeypatch.delitem(sys.modules, name)
    return ProgramStore(tmp_path, pytest.fail)


@pytest.fixture
def compiled(monkeypatch):
    """The number of programs that are traced and compiled."""
    count, compile_one = [], jax.stages.Lowered.compile

    def spy(self, *arguments, **options):
        count.append(1)
        return compile_one(self, *arguments, **options)

    monkeypatch.setattr(jax.stages.Lowered, "compile", spy)
    return count


def _bits(tree):
    return [np.asarray(x).tobytes() for x in jax.tree_util.tree_leaves(tree)]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in ("fix-kf", *SLOW)]
)
def test_a_program_of_an_earlier_process_gives_the_bits_of_a_traced_one(name, store, compiled):
    model, part = _case(name)
    traced = jitted(outputs, model, part)
    first = ProgramStore(store._path, pytest.fail).program(outputs, model, part, OPTIONS)(model, part)
    before = len(compiled)
    later = ProgramStore(store._path, pytest.fail).program(outputs, model, part, OPTIONS)(model, part)
    assert len(compiled) == before
    assert _bits(traced) == _bits(first) == _bits(later)
    assert jax.tree_util.tree_structure(traced) == jax.tree_util.tree_structure(later)


def test_other_numbers_use_the_program_and_other_shapes_functions_and_settings_do_not(fixes, store):
    model, part = fixes
    programs = ProgramStore(store._path, pytest.fail)
    first = programs.program(outputs, model, part, OPTIONS)
    louder = jax.tree_util.tree_map(lambda x: x + 0.5 if eqx.is_inexact_array(x) else x, model)
    assert programs.program(outputs, louder, part, OPTIONS) is first
    assert _bits(first(louder, part)) == _bits(jitted(outputs, louder, part))
    longer = jax.tree_util.tree_map(lambda x: np.concatenate([x, x]) if np.shape(x)[:1] == (16,) else x, part)
    others = [
        programs.program(outputs, model, longer, OPTIONS),
        programs.program(outputs_and_state, model, part, OPTIONS),
    ]
    with jax.default_matmul_precision("highest"):
        others.append(programs.program(outputs, model, part, OPTIONS))
    assert len({first, *others}) == 4


def test_a_damaged_program_is_traced_again(fixes, store):
    model, part = fixes
    right = _bits(ProgramStore(store._path, pytest.fail).program(outputs, model, part, OPTIONS)(model, part))
    (path,) = store._path.glob(f"{PREFIX}*")
    store.put(path.name, b"not a program")
    assert _bits(ProgramStore(store._path, pytest.fail).program(outputs, model, part, OPTIONS)(model, part)) == right
    path.write_bytes(b"junk")
    assert _bits(ProgramStore(store._path, pytest.fail).program(outputs, model, part, OPTIONS)(model, part)) == right


class _Mine(eqx.Module):
    """A model of code that no key has the text of."""

    x: Any


def test_code_of_others_is_traced(fixes, store, monkeypatch):
    model, part = fixes
    programs = ProgramStore(store._path, pytest.fail)
    assert programs.program(lambda model, part: model, model, part) is None
    assert programs.program(_case, model, part) is None
    assert programs.program(outputs, (_Mine(model[0]), None), part) is None
    monkeypatch.setitem(sys.modules, "trackwright_tracker_own", ModuleType("trackwright_tracker_own"))
    assert programs.program(outputs, model, part, OPTIONS) is None
