"""A chunk of a study as one program: its trajectories are drawn, tracked and scored without leaving the device.

Where each number of a tracker's rows comes from is found by a trajectory whose readings are all there and all differ;
another one, with some missing, must follow by the same rule. The places for starts, `nearby`, are computed from the
readings where the tracker says how. A tracker whose rows hold anything else that depends on readings, as the places
of range differences, has no such program: `chunk.py` runs it on recordings.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from trackwright.experiments.monte_carlo.scores import Scores, arrays_of, cells, sums
from trackwright.sim.keys import keys_of, seed_key, trajectory_keys
from trackwright.sim.tables import AbstractDraw, SimulatedTables, SimulatedWorld, as_numpy
from trackwright.trackers.catalogue import spec_of
from trackwright.trackers.core.data.estimates import Status, is_usable
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.model.algebra import triangle
from trackwright.trackers.core.model.rig import Station, angles_in_array
from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import with_values
from trackwright.trackers.core.programs import Program, compiled_program, kept_program, types_of
from trackwright.trackers.core.run.chunks import OPTIONS, as_dtype
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.parts.multilaterate import RangePlaces
from trackwright.trackers.parts.ranges import ANCHORS
from trackwright.trackers.parts.start_nearby import NEARBY, AbstractPlaces
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.tracks import TrackerBatch, Trajectories

# The first of the readings that all differ, and their step: no m or rad of them is wrapped or refused. Share of the
# readings of the second probe. Most trajectories together. Steps of the time of one, of which float32 has 2²⁴.
MARKS, SEEN, PIECE, TICKS = (0.5, 1e-6), 0.7, 256, 2**30

Batches = Callable[[RecordingFolder], list[TrackerBatch]]
Part = tuple[UInt32[np.ndarray, " 2"], UInt32[np.ndarray, " n"]]  # data of the seed's key, ids of the trajectories


class UnfitError(Exception):
    """A tracker's rows that do not follow from a world's arrays number by number."""


class Rows(eqx.Module):
    """How the rows of a tracker follow from the arrays of n drawn trajectories, of each S sequences of R rows.

    There are several sequences where a tracker takes each station by itself. `places` (S, R, m): of each reading among
    the drawn numbers, where `there`; `reported` and `inputs`: constant. `ticks` (R,): the times of rows, in steps of
    `tick` s; `group`: equal for rows of one time; `interval`, in which only the last row is scored; `truth`: the number
    of the true position. `heights` (S,) m: known ones, NaN for none. `nearby`: how that input follows from readings.
    """

    places: dict[str, Int[np.ndarray, "S R m"]]
    there: dict[str, Bool[np.ndarray, "S R m"]]
    reported: dict[str, Float[Any, "S R k"]]
    inputs: dict[str, Float[Any, "S R *shape"]]
    ticks: Int[np.ndarray, " R"]
    tick: float
    group: Int[np.ndarray, " R"]
    interval: Int[np.ndarray, " R"]
    truth: Int[np.ndarray, " R"]
    heights: Float[Any, " S"]
    truth_height: float
    nearby: AbstractPlaces | None
    stations: tuple[Station, ...] = eqx.field(static=True)
    times_differ: bool = eqx.field(static=True)
    regular: bool = eqx.field(static=True)

    def batch(self, draw: AbstractDraw, arrays: Mapping[str, Array]) -> Batch:
        """The batch of the S n sequences, those of one station side by side.

        A row without any reading is padding, unless the rows are `regular`.
        """
        values, seen = _flat([arrays[name] for name in draw.measured]), _flat([*draw.there(arrays).values()])

        def constant(x: Any) -> Array:
            """(S, R, …) as (R, …, S n)."""
            return jnp.repeat(jnp.moveaxis(x, 0, -1), values.shape[-1], axis=-1)

        def gathered(x: Array, place: Any) -> Array:
            # One sequence after the other: a transpose of them all takes several times as long as the filter.
            return jnp.concatenate([x[of_sequence] for of_sequence in place], axis=-1)

        readings = {}
        for name, place in self.places.items():
            there = gathered(seen, place) & constant(self.there[name])
            numbers = jnp.where(there, gathered(values, place), 0.0)
            readings[name] = Reading(numbers, there, constant(self.reported[name]))
        valid = jnp.any(jnp.concatenate([r.seen for r in readings.values()], axis=1), axis=1) | self.regular
        inputs = {name: constant(x) for name, x in self.inputs.items()}
        if self.nearby is not None:
            (reading,) = readings.values()
            inputs[NEARBY.name] = self.nearby(reading.values, reading.seen)
        key = jnp.zeros((2, valid.shape[1]), jnp.uint32)
        return Batch(self._steps(valid), valid, readings, inputs, {}, key)

    def _steps(self, valid: Bool[Array, "R B"]) -> Float[Array, "R B"]:
        """The time since the last valid row, s; zero for the first one."""
        ticks = jnp.asarray(self.ticks)[:, None]
        latest = jax.lax.cummax(jnp.where(valid, ticks, -1))
        before = jnp.concatenate([jnp.full_like(latest[:1], -1), latest[:-1]])
        return jnp.where(valid & (before >= 0), ticks - before, 0).astype(self.heights.dtype) * self.tick

    def true(self, arrays: Mapping[str, Array]) -> Float[Array, "R B axes"]:
        """The truth of all rows: positions (x, y, z), m, or azimuth and elevation from each station, rad."""
        # One contiguous array for each axis: with the axes last nothing is a vector operation.
        axes = [
            jax.lax.optimization_barrier(x)[self.truth] for x in jnp.moveaxis(arrays["positions"], 0, -1).swapaxes(0, 1)
        ]
        axes += [jnp.full_like(axes[0], self.truth_height)] * (3 - len(axes))
        if not self.stations:
            return jnp.stack([jnp.tile(x, len(self.heights)) for x in axes], axis=-1)
        each = []
        for station in self.stations:
            away = [x - x_of_station for x, x_of_station in zip(axes, station.position, strict=True)]
            columns = station.world_from_array().astype(away[0].dtype).T
            each.append(angles_in_array(jnp.stack([sum(a * m for a, m in zip(away, c, strict=True)) for c in columns])))
        return jnp.concatenate(each, axis=1)

    def scored(self, output: tuple[Array, ...], truth: Float[Array, "R B axes"]) -> Scores:
        """The scores of the n trajectories."""
        *moments, nis, dof, status = output
        axes = {2: 1, 5: 2, 9: 3}[len(moments)]
        estimates, sequences = jnp.stack(moments[:axes], axis=-1), len(self.heights)
        there, known = self._counted(status, jnp.isfinite(estimates[..., :2]).all(axis=-1))
        if axes < truth.shape[-1]:
            height = jnp.repeat(self.heights, nis.shape[1] // sequences)[:, None]
            estimates = jnp.concatenate([estimates, jnp.broadcast_to(height, (*nis.shape, 1))], axis=-1)

        def total(x: Array) -> Array:
            return x.sum(axis=0, dtype=nis.dtype).reshape(sequences, -1).sum(axis=0)

        entries = dict(zip(triangle(axes), moments[axes:], strict=True))
        found, sizes = sums(estimates, truth, entries, there, known, (status, nis, dof), total)
        if axes < truth.shape[-1]:
            sizes["3d_m"] = sizes["m"]
        rows = {kind: size.reshape(len(size), sequences, -1) for kind, size in sizes.items()}
        n = nis.shape[1] // sequences
        of_rows = {kind: cells(size, jnp.arange(n, dtype=jnp.int32), n) for kind, size in rows.items()}
        return Scores(found, {kind: size.max(axis=(0, 1)) for kind, size in rows.items()}, of_rows)

    def _counted(self, status: Int[Array, "R B"], finite: Bool[Array, "R B"]) -> tuple[Bool[Array, "R B"], ...]:
        """The last row of each time, and of those with an estimate the last of each interval, which are scored."""

        def last(rows: Bool[Array, "R B"], number: Int[np.ndarray, " R"]) -> Bool[Array, "R B"]:
            later = jax.lax.cummin(jnp.where(rows, number[:, None], TICKS), reverse=True)
            return rows & (jnp.concatenate([later[1:], jnp.full_like(later[:1], TICKS)]) > number[:, None])

        there, usable = status != Status.PADDING, is_usable(status)
        if not self.times_differ:
            failed = jax.ops.segment_max((status == Status.NON_FINITE).astype(jnp.int8), self.group, len(self.group))
            there = last(there, self.group)
            usable &= there & (failed[self.group] <= 0)
        return there, last(usable & finite, self.interval)


def _flat(arrays: list[Array]) -> Array:
    """The numbers of arrays (n, …) as (numbers, n), in memory: XLA would draw them anew in the order of their use."""
    return jax.lax.optimization_barrier(jnp.concatenate([jnp.moveaxis(x, 0, -1).reshape(-1, len(x)) for x in arrays]))


def chunk_scores(model: tuple[AbstractDraw, AbstractTracker, Rows], part: Part) -> Scores:
    """The scores of the trajectories of a part, differentiable by the numbers of the model."""
    draw, tracker, rows = model
    arrays = draw(keys_of(*part))
    with as_numpy():
        batch = rows.batch(draw, arrays)
        return rows.scored(tracker.accumulate(batch, _moments, every_row=True), rows.true(arrays))


def _moments(output: Any, truth: Any) -> tuple[Array, ...]:
    """Of one row: estimate and covariance of the position, or of azimuth and elevation, NIS, its dof and the status."""
    mean, cov = output.mean, list(output.cov)
    bearing = hasattr(mean, "azimuth")
    estimate = (mean.azimuth, mean.elevation) if bearing else tuple(mean.position)
    size = int((np.sqrt(8 * len(cov) + 1) - 1) / 2)
    state = jax.tree_util.tree_map(lambda x: np.zeros(np.shape(x)[:-1]), mean)
    fields = ("azimuth", "elevation") if bearing else ("position",)
    index = [k for k, name in enumerate(component_names(state)[:size]) if name.partition(".")[0] in fields]
    entry = {pair: k for k, pair in enumerate(triangle(size))}
    upper = [
        jnp.zeros_like(output.nis) if bearing and i != j else cov[entry[index[i], index[j]]]
        for i, j in triangle(len(index))
    ]
    return *estimate, *upper, output.nis, output.nis_dof, output.status


class ChunkProgram(NamedTuple):
    """The model of a condition and tracker, and its compiled program."""

    model: Any
    program: Program

    def run(self, part: Part) -> dict[str, np.ndarray]:
        """The arrays of a chunk, as of `tracked.scored`, computed in pieces that fit the processor's cache."""
        (key, ids), n, size = part, len(part[1]), piece_of(len(part[1]))
        ids = ids[np.minimum(np.arange(-(-n // size) * size), n - 1)]
        each = [self.program(self.model, (key, some)) for some in ids.reshape(-1, size)]
        return arrays_of([jax.tree_util.tree_map(np.asarray, scores) for scores in each], n)


def piece_of(n: int) -> int:
    """The trajectories of a piece of a chunk of n."""
    return -(-n // -(-n // PIECE))


def part_of(seed: int, ids: np.ndarray) -> Part:
    """The part of these trajectories."""
    return seed_key(seed), ids.astype(np.uint32)


def compiled(folder: RecordingFolder, batches: Batches, every: float | None, part: Part) -> ChunkProgram:
    """The program of a tracker for the world of a simulated folder; raises UnfitError where it has none.

    `batches`: of a folder, with the tracker's settings. `every`: s, an interval in which the last row alone is scored.
    """
    draw = folder.tables.draw if isinstance(folder.tables, SimulatedTables) else None
    if draw is None:
        raise UnfitError("the world has no draw")
    first = part[1][:1]
    drawn = draw.world(draw(keys_of(part[0], first)), first.astype(int)).folder(folder.name)
    alike = [name in folder.tables and table.equals(folder.tables[name]) for name, table in drawn.tables.items()]
    if not all(alike) or pickle.dumps((drawn.rig, None)) != pickle.dumps((folder.rig, folder.calibration)):
        raise UnfitError("the folder is not as it was drawn")
    model = as_dtype((draw, *_understood(draw, folder.name, batches, every)), jax.dtypes.canonicalize_dtype(float))
    try:
        return ChunkProgram(model, _program(model, part))
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        raise UnfitError("the world is drawn in NumPy alone") from error


def expected(
    world: SimulatedWorld, tracker: str, metric: str = "rmse_m", values: Mapping[str, Any] = MappingProxyType({}),
    anchors: Any = None,
) -> Any:  # fmt: skip
    """The expected RMSE or mean size of a tracker's errors on a world, to differentiate by the numbers of both.

    `world`: of `tw.simulate`, whose levels may be traced; the expectation is over its trajectories, which have the same
    random numbers in every call. `tracker`: of the catalogue, with these `values` of its tunables by name or pattern,
    which may be traced. `metric`: `rmse_` or `mean_` and a kind of error, as in `rmse_3d_m`. `anchors` (A, 3) m, in the
    order of their ids: places of a world of ranges and of its rig instead of the rig's own. Whether a reading is an
    outlier or lost, where a track begins, and how far bearings bend has no derivative. Raises UnusableInput for another
    metric, and for a tracker whose rows are no drawn numbers, as of range differences.
    """
    # In place of a traced level any number: rows do not depend on it.
    known = lambda x: np.full(np.shape(x), 0.5) if isinstance(x, jax.core.Tracer) else x  # noqa: E731
    spec, plain = spec_of(tracker), jax.tree_util.tree_map(known, world.draw)

    def batches(folder: RecordingFolder) -> list[TrackerBatch]:
        with jax.ensure_compile_time_eval():
            found = spec.batches([folder], tracker)
        return [replace(b, tracker=with_values(b.tracker, values, f"tracker '{tracker}'")) for b in found]

    try:
        model = world.draw, *_understood(plain, world.name, batches, None)
    except UnfitError as error:
        raise UnusableInput(f"expected: tracker '{tracker}' on {world.name}: {error}; run a study") from error
    # Not known to the compiler, which would draw constants.
    part = jax.tree_util.tree_map(jax.lax.optimization_barrier, part_of(world.seed, world.ids))
    model = as_dtype(model if anchors is None else _moved(*model, anchors), jax.dtypes.canonicalize_dtype(float))
    sums, (what, _, kind) = chunk_scores(model, part).sums, metric.partition("_")
    if what not in ("rmse", "mean") or f"n {kind}" not in sums:
        kinds = ", ".join(name[2:] for name in sums if name.startswith("n ") and f"squares {name[2:]}" in sums)
        raise UnusableInput(f"expected: metric '{metric}'; expected rmse_KIND or mean_KIND with one of {kinds}")
    n = sums[f"n {kind}"].sum()
    return jnp.sqrt(sums[f"squares {kind}"].sum() / n) if what == "rmse" else sums[f"sum {kind}"].sum() / n


def _moved(draw: Any, tracker: Any, rows: Rows, anchors: Any) -> tuple[Any, Any, Rows]:
    """A model of ranges whose anchors are at other places (A, 3), m, which may be traced."""
    nearby, own = rows.nearby, draw.rig.anchors if hasattr(draw, "rig") else {}
    if not isinstance(nearby, RangePlaces) or np.shape(anchors) != (len(own), 3):
        fix = f"expected ({len(own)}, 3), m, and a world and a tracker of ranges alone"
        raise UnusableInput(f"expected: anchors have shape {np.shape(anchors)}; {fix}")
    places, number = jnp.asarray(anchors), rows.inputs["anchor"][..., 0].astype(int)
    in_rig = places[np.array([sorted(own).index(name) for name in own])]
    inputs = {**rows.inputs, ANCHORS.name: places[number]}
    rows = replace(rows, inputs=inputs, nearby=replace(nearby, anchors=places))
    return replace(draw, places=in_rig), tracker, rows


_programs: dict[bytes, Program] = {}


def _program(model: Any, part: Part) -> Program:
    """The program of a model of these shapes: conditions that differ in numbers alone share it."""
    if (program := kept_program(chunk_scores, model, part, OPTIONS)) is not None:
        return program
    try:
        key = pickle.dumps((types_of((model, part)), jax.config.jax_enable_x64))  # type: ignore[attr-defined]
    except (pickle.PicklingError, TypeError, AttributeError):
        return compiled_program(chunk_scores, model, part, OPTIONS)
    if key not in _programs:
        _programs[key] = compiled_program(chunk_scores, model, part, OPTIONS)
    return _programs[key]


def _understood(draw: AbstractDraw, name: str, batches: Batches, every: float | None) -> tuple[AbstractTracker, Rows]:
    """The tracker of a world's folders, and how its rows follow from the draw; raises UnfitError."""
    if not draw.measured:
        raise UnfitError("the world has no draw for programs")
    probes = [_probe(draw, name, number, batches) for number in range(2)]
    tracker = probes[0].batch.tracker.for_positions()
    if getattr(getattr(tracker, "filter", None), "has_particle_axis", False):
        raise UnfitError("the filter has particles or cells")
    latency = getattr(tracker, "latency", None)
    if isinstance(latency, jax.core.Tracer) or latency not in (None, 0.0):
        raise UnfitError("estimates are late")
    return tracker, _rows(draw, probes, every)


class _Probe(NamedTuple):
    """A trajectory of a world: the numbers that were drawn, which of them are there, and its rows."""

    numbers: np.ndarray
    there: np.ndarray
    batch: TrackerBatch
    trajectories: Trajectories


def _probe(draw: AbstractDraw, name: str, number: int, batches: Batches) -> _Probe:
    """The probe of one trajectory: of the first each number is another one, of the second some are not there."""
    with jax.ensure_compile_time_eval():
        arrays, draws = draw(trajectory_keys(0, [number])), np.random.default_rng(0)
    marks = MARKS[0] + np.arange(sum(arrays[of].size for of in draw.measured)) * MARKS[1]
    for of, mask in draw.measured.items():
        if number == 0:
            arrays[of], marks = marks[: arrays[of].size].reshape(arrays[of].shape), marks[arrays[of].size :]
            arrays[mask] = np.ones_like(arrays[mask])
        else:
            # Every third time has none, so that it shows whether a row without a reading is there.
            by_time = np.arange(arrays[mask].shape[1]).reshape(-1, *[1] * (arrays[mask].ndim - 2)) % 3 != 1
            arrays[mask] = (draws.random(arrays[mask].shape) < SEEN) & by_time
    try:
        found = batches(draw.world(dict(arrays), np.array([number])).folder(name))
    except UnusableInput as error:
        raise UnfitError(str(error)) from error
    if len(found) != 1:
        raise UnfitError("the world has trajectories of several trackers")
    trajectories = Trajectories.of(found[0].trajectories)
    if set(trajectories.tags) != {str(number)}:
        raise UnfitError("a body has several tags")
    both = [arrays[of] for of in draw.measured], draw.there(arrays).values()
    values, there = (np.concatenate([x.ravel() for x in each]) for each in both)
    return _Probe(values, there, found[0], trajectories)


def _rows(draw: AbstractDraw, probes: Sequence[_Probe], every: float | None) -> Rows:
    """How the rows follow from the numbers, by two probes; raises UnfitError."""
    (numbers, _, batch, trajectories), columns = probes[0], probes[0].trajectories.columns
    S, lengths = len(columns), np.diff(columns.starts)
    if len({*lengths}) != 1 or len(draw.times) < 2:
        raise UnfitError("trajectories have different numbers of rows, or a single one")

    def sequences(x: np.ndarray) -> np.ndarray:
        return x.reshape(S, len(x) // S, *x.shape[1:])

    times = sequences(columns.times)
    if not (times == times[0]).all():
        raise UnfitError("trajectories have different times")
    truth = np.minimum(np.searchsorted(draw.times, times[0] - 1e-9), len(draw.times) - 1)
    true, known = columns.truth["direction" if "direction" in columns.truth else "position"]
    if np.abs(draw.times[truth] - times[0]).max() > 1e-9 or not known.all():
        raise UnfitError("rows lie between the times of the truth")
    heights, folder = trajectories.heights, trajectories.folders[0]
    if batch.planar and np.isnan(heights).any() and not trajectories.stations[0]:
        raise UnfitError("the height of a planar estimate is unknown")
    places, there, reported = {}, {}, {}
    for name, readings in columns.readings.items():
        place = np.minimum(np.searchsorted(numbers, readings.values), len(numbers) - 1)
        places[name] = sequences(np.where(readings.seen, place, 0).astype(np.int32))
        there[name] = sequences(readings.seen)
        of_row = readings.reported
        reported[name] = sequences(np.zeros((len(columns.times), 0)) if of_row is None else of_row)
    nearby = batch.places(trajectories, batch.planar) if batch.places else None
    inputs = {k: sequences(x) for k, x in columns.inputs.items() if nearby is None or k != NEARBY.name}
    # A fraction of the shortest step between rows; one number of steps for both, so that their order is kept.
    span = times[0][-1] - times[0][0]
    ticks = np.round((times[0] - times[0][0]) / (span or 1.0) * TICKS).astype(np.int32)
    group = np.unique(times[0], return_inverse=True)[1].astype(np.int32)
    interval = np.arange(len(group)) if every is None else np.floor(times[0] / every + 1e-6)
    stations = tuple(folder.rig.stations[name] for name in trajectories.stations if name)
    regular = _check(places, there, reported, inputs, times, probes)
    truth_height, differ = float(true[0, -1]), len(set(group.tolist())) == len(group)
    of_times = ticks, (span or 1.0) / TICKS, group, interval.astype(np.int32), truth
    return Rows(places, there, reported, inputs, *of_times, heights, truth_height, nearby, stations, differ, regular)


def _check(places: Any, there: Any, reported: Any, inputs: Any, times: np.ndarray, probes: Sequence[_Probe]) -> bool:
    """Whether rows without a reading are there; raises UnfitError unless both probes have the rows that follow."""
    for probe in probes:
        seen = {name: probe.there[place] & there[name] for name, place in places.items()}
        valid, columns = np.any(np.concatenate([*seen.values()], axis=2), axis=2), probe.trajectories.columns
        valid |= (regular := len(columns.times) == valid.size)
        if not np.array_equal(valid.sum(axis=1), np.diff(columns.starts)) or (times[valid] != columns.times).any():
            raise UnfitError("a row is there for another reason than a reading")
        pairs = [(x[valid], columns.inputs[name]) for name, x in inputs.items()]
        for name, place in places.items():
            readings, values = columns.readings[name], np.where(seen[name], probe.numbers[place], 0.0)
            pairs += [(seen[name][valid], readings.seen), (values[valid], readings.values)]
            pairs += [] if readings.reported is None else [(reported[name][valid], readings.reported)]
        if not all(np.array_equal(a, b) for a, b in pairs):
            raise UnfitError("a row holds other numbers than its own readings")
    return regular
