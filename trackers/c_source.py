"""A tracker as C99: the step of one trajectory, from the program that jax traces, without a heap, for firmware.

Each number of the program is a local variable; what is constant, as levels and geometry of the tracker, stands in the
text. A tracker whose start or update searches, draws or sorts has no such program and is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.core.data.recording import Recording, stack
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.jax_private import is_literal, live_part
from trackwright.trackers.core.model.algebra import select
from trackwright.trackers.core.model.covariance import Gaussian, as_scalars
from trackwright.trackers.core.model.sensor import Row
from trackwright.trackers.core.model.state import component_names
from trackwright.trackers.core.model.tunable import freeze, tunables
from trackwright.trackers.core.run import scan
from trackwright.trackers.core.run.chunks import as_dtype
from trackwright.trackers.core.run.tracker import AbstractTracker, Tracker
from trackwright.trackers.recordings.files import write_whole
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.trackers.recordings.tracks_table import require_new

SIGNS = {"add": "+", "add_any": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|"}
SIGNS |= {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
TEMPLATES = {
    **{name: f"{{0}} {sign} {{1}}" for name, sign in SIGNS.items()},
    **{name: name + "{f}({0})" for name in ("sqrt", "log", "log1p", "exp", "expm1", "sin", "cos", "tan", "tanh")},
    **{name: name + "{f}({0})" for name in ("ceil", "floor", "acos", "asin", "lgamma", "erf")},
    **{name: name + "{f}({0}, {1})" for name in ("atan2", "pow")},
    "abs": "fabs{f}({0})",
    "round": "{nearest}{f}({0})",
    # As in XLA what is no number wins.
    "max": "({0} > {1} || {0} != {0}) ? {0} : {1}",
    "min": "({0} < {1} || {0} != {0}) ? {0} : {1}",
    "neg": "-{0}",
    "not": "!{0}",
    "is_finite": "isfinite({0}) != 0",
    "sign": "({real})(({0} > 0) - ({0} < 0))",
    "square": "{0} * {0}",
    "logistic": "1 / (1 + exp{f}(-{0}))",
    "rsqrt": "1 / sqrt{f}({0})",
    "select_n": "{0} ? {2} : {1}",
}
"""An operation on numbers in C, by its name in jax; `f`: the suffix of functions."""

POWER, CONVERTED = "integer_pow", "convert_element_type"
SAME = ("compute_once", "stored", "copy", "copy_p", "stop_gradient", "optimization_barrier")
NESTED = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint", "custom_vmap_call")
MOVED = ("broadcast_in_dim", "reshape", "squeeze", "slice", "concatenate", "stack", "unstack", "transpose", "split")
REDUCED = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_and": "and", "reduce_or": "or"}


class Source(NamedTuple):
    """C99 text of a tracker: `header`, `body`; `columns`: of a row in a CSV file that the program's `main` replays."""

    header: str
    body: str
    columns: tuple[str, ...]


def one_row(tracker: Any, carry: scan.Carry, row: Row, starts: bool) -> tuple[scan.Carry, tuple[Any, ...]]:
    """A trajectory's carry after a row, which may start a track if `starts`, and the output of `scan.scan_rows`."""
    belief, innovation = tracker.update(tracker.predict(carry.belief, row), row)
    carry, info = tracker.advance(carry, row, belief, innovation)
    if starts:
        need = scan.starting(carry, row, tracker.start.can_start(row), info)
        fresh = scan.in_form(scan.initial_carry(tracker, tracker.start.candidate(tracker.sensors, row), row), False)
        carry, info = select(need, fresh, carry), scan.with_start(carry, need, info)
    mean, cov = tracker.moments(carry.belief)
    return carry, (mean, tuple(as_scalars(cov)), *info)


def c_source(
    tracker: AbstractTracker, recording: Recording, name: str = "tracker", about: str = "", double: bool = False
) -> Source:
    """The C source of a tracker for rows as those of a recording.

    `name`: of the functions NAME_init and NAME_step; where a start searches, NAME_begin starts a track from a mean and
    covariance instead. `about`: a comment. `double`: in double precision. Raises UnusableInput, naming the operation,
    for a tracker whose step is more than arithmetic.
    """
    if not isinstance(tracker, Tracker):
        raise UnusableInput(f"{type(tracker).__name__} has no step in C; expected a filter, as of fix-kf or uwb")
    with jax.enable_x64(double):
        dtype, begin = np.float64 if double else np.float32, None
        model, row = freeze(as_dtype(tracker, dtype)), _first(_rows(recording), dtype)
        carry = scan.first_carry(model, row, False)
        try:
            step = _traced(lambda s, r: one_row(model, s, r, True), double, s=carry, r=row)
        except NotImplementedError:
            try:
                step = _traced(lambda s, r: one_row(model, s, r, False), double, s=carry, r=row)
                mean, cov = model.moments(carry.belief)
                given = {"m": mean, "c": tuple(as_scalars(cov))}
                begin = _traced(lambda *x: scan.carry_of(model, Gaussian(*x), row.key, row.number), double, **given)
            except NotImplementedError as error:
                words = "as of a search, a loop or random numbers; expected arithmetic"
                raise UnusableInput(f"the tracker has the operation {error}, {words}") from None
        return _written(name, about or name, tracker, carry, row, step, begin, "double" if double else "float")


class _Text(NamedTuple):
    """Statements that compute `results`, arrays of names and numbers; `needed`: the names that they read or define."""

    lines: list[str]
    results: list[np.ndarray]
    needed: set[str]
    shapes: Any


def _traced(function: Callable[..., Any], double: bool, **arguments: Any) -> _Text:
    """A function's statements; the numbers of an argument are called after it. Raises NotImplementedError."""
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments.values())
    live, used = live_part(closed.jaxpr)
    names = [
        np.array([f"{prefix}{k}_{i}" for i in range(np.size(x))], object).reshape(np.shape(x))
        for prefix, tree in arguments.items()
        for k, x in enumerate(jax.tree_util.tree_leaves(tree))
    ]
    program = _Program(double)
    results = program.run(live, closed.consts, [x for x, u in zip(names, used, strict=True) if u])
    needed, lines = program.needed([x for array in results for x in array.ravel()])
    return _Text(lines, results, needed, shapes)


def write_c(named: NamedTracker, recording: RecordingFolder, out: Path, force: bool = False) -> list[Path]:
    """Writes the C source of a tracker for a recording: `out`, its header, and the rows of the first tag as CSV.

    The name of the file is that of the functions. `force`: replace files. Raises UnusableInput as `c_source`.
    """
    batches = named.batches(recording)
    if len(batches) > 1:
        raise UnusableInput(f"{recording.path}: its tags need {len(batches)} trackers; expected one; choose a --tag")
    first, name = batches[0].trajectories[0].recording, _identifier(out.stem)
    paths = {".c": out, ".h": out.with_name(f"{name}.h"), ".csv": out.with_suffix(".csv")}
    for ending, path in paths.items():
        require_new(path, f"tracker{ending}", force)
    zero = f"; positions are from x = {recording.origin[0]!r}, y = {recording.origin[1]!r} m" * any(recording.origin)
    source = c_source(batches[0].tracker, first, name, f"{named.name} for {recording.name}{zero}")
    rows = "".join(",".join(map(repr, row)) + "\n" for row in rows_of(first, source.columns).tolist())
    return [write_whole(*both) for both in zip(paths.values(), (source.body, source.header, rows), strict=True)]


def rows_of(recording: Recording, columns: Sequence[str]) -> np.ndarray:
    """The rows (T, columns) of a recording for the program of `c_source`."""
    fields = jax.tree_util.tree_flatten_with_path(_rows(recording))[0]
    whole = {_column(path, i): np.reshape(x, (len(x), -1))[:, i] for path, x in fields for i in range(np.size(x[0]))}
    return np.stack([np.asarray(whole[column], float) for column in columns], axis=1)


def _rows(recording: Recording) -> Row:
    """The rows of a recording, (T, ..., 1)."""
    batch = stack([recording])
    return Row(batch.dt, batch.valid, batch.readings, batch.inputs, None, None)


def _first(rows: Row, dtype: Any) -> Row:
    """The first row."""
    row: Row = as_dtype(jax.tree_util.tree_map(lambda x: np.asarray(x)[0][..., 0], rows), dtype)
    return row._replace(key=jnp.zeros(2, jnp.uint32), number=jnp.uint32(0))


def _identifier(text: str) -> str:
    """The text as a name in C."""
    return re.sub(r"^(?=\d)", "x", re.sub(r"\W", "_", text, flags=re.ASCII))


def _column(path: Any, index: int) -> str:
    """The name of a number of a row, as `ranges_values_0`."""
    words = [str(getattr(key, "name", getattr(key, "key", ""))) for key in path]
    words = words[1:] if words[0] in ("readings", "inputs") else words
    return _identifier("_".join(words)) + ("" if words in (["dt"], ["valid"]) else f"_{index}")


class _Program:
    """Statements of C for the equations of a program; arrays are arrays of names and numbers."""

    def __init__(self, double: bool) -> None:
        self.suffix, self.real = ("", "double") if double else ("f", "float")
        self.lines: dict[str, tuple[str, str]] = {}
        self.seen: dict[str, str] = {}

    def run(self, program: Any, constants: Sequence[Any], arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The results of a program's equations."""
        known = dict(zip([*program.constvars, *program.invars], [*map(_objects, constants), *arguments], strict=True))

        def value(x: Any) -> np.ndarray:
            return _objects(x.val) if is_literal(x) else known[x]

        for equation in program.eqns:
            results = self.equation(equation, [value(x) for x in equation.invars])
            known |= zip(equation.outvars, map(_objects, results), strict=True)
        return [value(x) for x in program.outvars]

    def equation(self, equation: Any, inputs: list[np.ndarray]) -> list[Any]:
        """The results of one equation."""
        name, parameters, result = equation.primitive.name, equation.params, equation.outvars[0].aval
        if name in NESTED:
            inner = next(parameters[key] for key in ("jaxpr", "call_jaxpr", "call") if key in parameters)
            return self.run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs)
        if name in SAME:
            return inputs
        if not any(isinstance(x, str) for array in inputs for x in array.flat):
            values = [jnp.asarray(x.tolist(), v.aval.dtype) for x, v in zip(inputs, equation.invars, strict=True)]
            return _bound(equation, values)
        if name in MOVED:
            # Elements go where their numbers go.
            elements, ends = np.concatenate([x.ravel() for x in inputs]), np.cumsum([x.size for x in inputs])
            numbers = [jnp.arange(end - x.size, end).reshape(x.shape) for x, end in zip(inputs, ends, strict=True)]
            return [elements[np.asarray(moved)] for moved in _bound(equation, numbers)]
        if name in REDUCED:
            axes = parameters["axes"]
            parts = np.moveaxis(inputs[0], axes, range(len(axes))).reshape(-1, *result.shape)
            return [self.summed(REDUCED[name], parts, result.dtype)]
        if name == "dot_general":
            return [self.product(inputs, parameters["dimension_numbers"], result.dtype).reshape(result.shape)]
        return [self.each(name, inputs, parameters, result.dtype)]

    def product(self, factors: Sequence[np.ndarray], numbers: Any, dtype: Any) -> np.ndarray:
        """A product of matrices without batches, in rows and columns."""
        contracted, (batched, _) = numbers
        if batched:
            raise NotImplementedError("dot_general")
        count = int(np.prod([factors[0].shape[axis] for axis in contracted[0]]))
        parts = zip(factors, contracted, strict=True)
        first, second = (np.moveaxis(x, axes, range(len(axes))).reshape(count, -1) for x, axes in parts)
        return self.summed("add", self.each("mul", [first[:, :, None], second[:, None]], {}, dtype), dtype)

    def summed(self, name: str, parts: np.ndarray, dtype: Any) -> np.ndarray:
        """The parts (n, …) joined one after another by an operation."""
        return reduce(lambda whole, part: self.each(name, [_objects(whole), _objects(part)], {}, dtype), parts)

    def each(self, name: str, inputs: list[np.ndarray], parameters: Mapping[str, Any], dtype: Any) -> np.ndarray:
        """An operation on each element; raises NotImplementedError for any other one, and for integers that wrap."""
        whole, size = np.issubdtype(dtype, np.integer), np.dtype(dtype).itemsize
        wraps = whole and (name == "not" or (size < 4 and name in ("add", "sub", "mul", "neg")))
        if wraps or name not in (*TEMPLATES, POWER, CONVERTED) or (name == "select_n" and len(inputs) != 3):
            raise NotImplementedError(f"{name} of {dtype}" if wraps else name)
        spread = np.broadcast_arrays(*inputs)
        results = [self.operation(name, x, parameters, dtype) for x in zip(*(x.flat for x in spread), strict=True)]
        return np.array(results, object).reshape(spread[0].shape)

    def operation(self, name: str, given: Sequence[Any], parameters: Mapping[str, Any], dtype: Any) -> str:
        """The variable with the result of an operation on numbers."""
        x = [self.text(value) for value in given]
        if name == CONVERTED:
            flag, whole = np.issubdtype(dtype, np.bool_), np.issubdtype(dtype, np.integer)
            return self.variable(f"{x[0]} != 0" if flag else f"({'int' if whole else self.real}){x[0]}", dtype)
        if name == POWER:
            power = " * ".join(x * abs(parameters["y"])) or "1"
            return self.variable(power if parameters["y"] >= 0 else f"1 / ({power})", dtype)
        nearest = "rint" if parameters.get("rounding_method") == jax.lax.RoundingMethod.TO_NEAREST_EVEN else "round"
        return self.variable(TEMPLATES[name].format(*x, f=self.suffix, real=self.real, nearest=nearest), dtype)

    def variable(self, expression: str, dtype: Any) -> str:
        """The variable with the value of an expression, one for equal ones."""
        if expression not in self.seen:
            name = self.seen[expression] = f"t{len(self.lines)}"
            self.lines[name] = (self.real if np.issubdtype(dtype, np.floating) else "int", expression)
        return self.seen[expression]

    def text(self, value: Any) -> str:
        """A number, or the name of a variable."""
        if isinstance(value, str):
            return value
        if isinstance(value, (bool, np.bool_, int, np.integer)):
            return str(int(value)) if value >= 0 else f"({int(value)})"
        if not np.isfinite(value):
            return "NAN" if value != value else "INFINITY" if value > 0 else "(-INFINITY)"
        digits = repr(float(value)) if self.suffix == "" else np.format_float_scientific(np.float32(value))
        digits = digits if any(c in digits for c in ".e") else digits + ".0"
        return f"{digits}{self.suffix}" if value >= 0 else f"({digits}{self.suffix})"

    def needed(self, results: Sequence[Any]) -> tuple[set[str], list[str]]:
        """The names that results depend on, and the statements that compute these."""
        needed = {x for x in results if isinstance(x, str)}
        lines = []
        for name, (kind, expression) in reversed(self.lines.items()):
            if name in needed:
                needed |= set(re.findall(r"\b[rst]\d+(?:_\d+)?\b", expression))
                lines.append(f"    const {kind} {name} = {expression};")
        return needed, lines[::-1]


def _objects(values: Any) -> np.ndarray:
    """An array of names and numbers."""
    return np.asarray(values if isinstance(values, str) else np.asarray(values), object)


def _bound(equation: Any, values: Sequence[Any]) -> list[Any]:
    """The results of an equation for these values."""
    return jax.tree_util.tree_leaves(equation.primitive.bind(*values, **equation.params))


def _written(
    name: str, about: str, tracker: Tracker, carry: scan.Carry, row: Row, step: _Text, begin: _Text | None, real: str
) -> Source:
    program, state = _Program(real == "double"), jax.tree_util.tree_leaves(carry)
    leaves = [(f"s{k}", x) for k, x in enumerate(state)]
    places = [f"{key}_{i}" for key, x in leaves for i in range(np.size(x))]
    sources = {key: f"state->s[{k}]" for k, key in enumerate(places)}
    for k, (path, x) in enumerate(jax.tree_util.tree_flatten_with_path(row)[0]):
        leaves.append((f"r{k}", x))
        sources |= {f"r{k}_{i}": f"row->{_column(path, i)}" for i in range(np.size(x))}
    flags = {key for key, x in leaves if x.dtype == bool}
    read = [(key, source, key.partition("_")[0] in flags) for key, source in sources.items() if key in step.needed]
    columns = tuple(source[5:] for _, source, _ in read if source.startswith("row"))
    loads = [f"    const {'int' if f else real} {key} = {source}{' != 0' * f};" for key, source, f in read]

    def stored(arrays: Sequence[Any], target: str = "    state->s[{}] = {};") -> list[str]:
        return [target.format(k, program.text(x)) for k, x in enumerate(y for of in arrays for y in np.ravel(of))]

    components = component_names(step.shapes[1][0])
    names = [*components, *(f"cov_{k}" for k in range(len(step.shapes[1][1]))), *scan.StepInfo._fields]
    outputs = [_identifier(output) for output in names]
    outs = [line.format(*outputs) for line in stored(step.results[len(state) :], "    out->{{{}}} = {};")]
    levels = [f" * {key} = {np.asarray(x.value).tolist()} {x.unit}" for key, x in tunables(tracker).items()]
    told = "\n".join([f" * {about}, written by trackwright.", *levels])
    told = re.sub(r"(?<=/)(?=\*)|(?<=\*)(?=/)", " ", told)  # no comment begins or ends there
    if alike := [x for fields in (columns, outputs) for x in fields if fields.count(x) > 1]:
        raise UnusableInput(f"two names of the tracker are both {alike[0]} in C; rename one")
    signature = f"void {name}_step({name}_state *state, const {name}_row *row, {name}_out *out)"
    functions = {f"void {name}_init({name}_state *state)": stored(state)}
    functions[signature] = [*loads, *step.lines, *stored(step.results[: len(state)]), *outs]
    if begin is not None:
        sizes = {"mean": len(components), "cov": len(step.shapes[1][1])}
        given = {f"{key[0]}{k}_0": f"{key}[{k}]" for key, size in sizes.items() for k in range(size)}
        used = [f"    const {real} {a} = {b};" for a, b in given.items() if a in begin.needed]
        arguments = ", ".join(f"const {real} {key}[{size}]" for key, size in sizes.items())
        signature = f"void {name}_begin({name}_state *state, {arguments})"
        functions[signature] = [*used, *begin.lines, *stored(begin.results)]
    guard, line = name.upper(), "\n"
    bodies = "\n\n".join(line.join([signature, "{", *body, "}"]) for signature, body in functions.items())
    header = f"""/*
{told}
 */
#ifndef {guard}_H
#define {guard}_H

/* A row: dt since the row before, s; valid and seen are 0 or 1; what is not seen is 0. */
typedef struct {{
{line.join(f"    {real} {column};" for column in columns)}
}} {name}_row;

/* cov: the upper triangle, row by row. status: {", ".join(f"{s.value} {s.name.lower()}" for s in Status)}. */
typedef struct {{
{line.join(f"    {real} {output};" for output in outputs)}
}} {name}_out;

typedef struct {{
    {real} s[{len(places)}];
}} {name}_state;

{line.join(f"{signature};" for signature in functions)}

#endif
"""
    form = ",".join(["%.9g" if real == "float" else "%.17g"] * len(outputs))
    body = f"""#include "{name}.h"

#include <math.h>

{bodies}

#ifdef {guard}_MAIN
#include <stdio.h>

/* Replays lines of {len(columns)} numbers, the fields of a row, from the standard input. */
int main(void)
{{
    {name}_state state;
    {name}_row row;
    {name}_out out;
    double x[{len(columns)}];
    {name}_init(&state);
    for (;;) {{
        for (int k = 0; k < {len(columns)}; k++) {{
            if (scanf(k ? ",%lf" : "%lf", &x[k]) != 1) return 0;
        }}
{line.join(f"        row.{column} = ({real})x[{k}];" for k, column in enumerate(columns))}
        {name}_step(&state, &row, &out);
        printf("{form}\\n", {", ".join(f"(double)out.{output}" for output in outputs)});
    }}
}}
#endif
"""
    return Source(header, body, columns)
