"""A Kalman filter that a user has, as matrices or plain functions, as a tracker like every other.

The state at the first row, before its measurement, is normal with mean `x0` and covariance `P0`, as in pykalman and
statsmodels; filters that predict first, as filterpy's, begin with F x0 and F P0 Fᵀ + Q.
"""

from __future__ import annotations

import inspect
import warnings
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from trackwright.trackers.core.data.recording import Readings, Recording, known_rows, masked, variances
from trackwright.trackers.core.errors import UnusableInput, floats, listed, require
from trackwright.trackers.core.filters.filter import AbstractStart
from trackwright.trackers.core.model.algebra import Scalar, Vector, cholesky, times, total, triangle
from trackwright.trackers.core.model.covariance import Gaussian
from trackwright.trackers.core.model.inputs import Inputs
from trackwright.trackers.core.model.motion import AbstractMotion, Noise
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Reading, Residual, Row
from trackwright.trackers.core.model.tunable import Covariance, Role, Scale
from trackwright.trackers.core.run.track_loss import TrackLossPolicy
from trackwright.trackers.core.run.tracker import Tracker
from trackwright.trackers.parts.fixes import correlated

Matrix = Float[np.ndarray, "n n"] | Callable[..., Any] | tuple[Callable[..., Any], Mapping[str, float]]
"""A covariance: an array; a function of `dt`, s; or a function of `dt` and numbers to tune, with their first values.

One R holds for all rows, whatever `dt`: the argument is there for the same form.
"""

SENSOR = "z"  # the name of the readings where there is one sensor alone
# Variance of each component of the state where no `P0` is given, and the least of them in single precision.
DIFFUSE, LEAST_DIFFUSE = 1e6, 1e3
COARSE = 0.02  # rounding of the values of a series, in their changes from row to row, from which it counts
RESOLVED = 2.0**15  # the most by which a reading reduces a variance in single precision, see `sequential_updates`

_SINGULAR = 1e-12


def linear(
    F: Any, H: Any, Q: Matrix, R: Any, *, x0: Sequence[float] | None = None, P0: Any = None, B: Any = None,
    state: Mapping[str, int] | None = None,
) -> Tracker:  # fmt: skip
    """The Kalman filter of x' = F x + B u + N(0, Q) and z = H x + N(0, R).

    F (n, n), H (m, n) and B (n, k) are arrays, or functions that return arrays: of `dt`, s, or of `dt` and the row's
    inputs (H: of the inputs alone), which `series` takes by name. u (T, k) is the input `u` of `series`. Several
    sensors: H and R by their names. Q, R: see `Matrix`; a full array is tuned as a covariance, a diagonal one by its
    standard deviations, a singular Q by a common factor, a function by its numbers. P0: by default 1e6 · I, in single
    precision down to 1e3 · I where readings are so precise that it cannot hold both. `state`: names of parts of the
    state with their lengths in order, as {"position": 2, "velocity": 2}; metrics know `position`. Raises UnusableInput
    for shapes that do not fit.
    """
    sensors = H if isinstance(H, Mapping) else {SENSOR: H}
    matrices = [np.atleast_2d(floats("F and H", h)) for h in (F, *sensors.values()) if not callable(h)]
    size = matrices[0].shape[1] if matrices else len(() if x0 is None else x0)
    forward, control = _product("F", F, size, size), None if B is None else _product("B", B, size)
    width = "k" if B is None or callable(B) else np.atleast_2d(B).shape[1]

    def step(x: Vector, dt: Scalar, inputs: Inputs) -> list[Scalar]:
        moved = forward(x, dt, inputs)
        if control is None:
            _refuse_unread(inputs, "linear", "no B; give B", (F, 1), *((h, 0) for h in sensors.values()))
            return moved
        u = jnp.atleast_1d(jnp.asarray(inputs["u"]))
        _fits("the input u of a row", u.shape, width)
        return [a + b for a, b in zip(moved, control([u[k] for k in range(len(u))], dt, inputs), strict=True)]

    functions = {name: _product(f"H of {name}", h, "m", size) for name, h in sensors.items()}
    gains = {name: float(np.square(h).max()) for name, h in sensors.items() if not callable(h)}
    return _tracker(step, functions, Q, R, size, x0, P0, state, gains)


def nonlinear(
    step: Callable[..., Any], measure: Any, Q: Matrix, R: Any, *, x0: Sequence[float], P0: Any = None,
    state: Mapping[str, int] | None = None,
) -> Tracker:  # fmt: skip
    """The extended Kalman filter of x' = step(x, dt) + N(0, Q) and z = measure(x) + N(0, R), by automatic derivatives.

    Both are functions of jax arrays, x (n,), with the row's inputs as a further argument if they take one, and may
    return a sequence of numbers. Otherwise as `linear`.
    """
    sensors = measure if isinstance(measure, Mapping) else {SENSOR: measure}

    def moved(x: Vector, dt: Scalar, inputs: Inputs) -> Any:
        words = "no function that takes it; let `step` take `inputs` last"
        _refuse_unread(inputs, "nonlinear", words, (step, 2), *((h, 1) for h in sensors.values()))
        return _called(step, x.array(), dt, inputs)

    functions = {name: (lambda x, inputs, h=h: _called(h, x.array(), inputs)) for name, h in sensors.items()}
    return _tracker(moved, functions, Q, R, len(x0), x0, P0, state, {})


def series(
    z: Any, *, times: np.ndarray | None = None, std: Any = None, truth: Mapping[str, np.ndarray] | None = None,
    name: str = "series", **inputs: np.ndarray,
) -> Recording:  # fmt: skip
    """Measurements for a tracker of `linear` or `nonlinear`: z (T, m) or (T,), by sensor where there are several.

    NaN marks a missing value; a sensor at a rate of its own has NaN in the other rows. `times`: (T,) s, by default
    0, 1, 2 …. `std`: standard deviations of the shape of z, which add to R. `inputs`: arrays (T, …) by name, as u=….
    `truth`: (T, d) by the name of a part of the state. Raises UnusableInput for arrays that do not fit.
    """
    require(truth is None or isinstance(truth, Mapping), "series", truth, "truth by part of the state, as {'x': truth}")
    by_sensor, spread = (x if isinstance(x, Mapping) else {SENSOR: x} for x in (z, {} if std is None else std))
    if unknown := [sensor for sensor in spread if sensor not in by_sensor]:
        raise UnusableInput(f"series: std of {listed(unknown)}; expected that of {listed(by_sensor)}, as of z")
    readings, rows = {}, len(np.atleast_1d(next(iter(by_sensor.values()), ()) if times is None else times))
    for sensor, x in by_sensor.items():
        values, seen = masked(f"series: the values of {sensor}", x, rows)
        readings[sensor] = Readings(values, seen, variances(spread.get(sensor), values))
        size = np.median(np.abs(values), axis=0)
        changes = np.median(np.abs(np.diff(values, axis=0, prepend=values[:1])), axis=0)
        step = np.spacing(size.astype(jax.dtypes.canonicalize_dtype(float)))
        if ((step > COARSE * changes) & (changes > 0)).any():
            found = f"series: values of {sensor} of {size.max():.3g} have steps of {step.max():.2g} in single precision"
            warnings.warn(f"{found}; subtract an origin, or jax.config.update('jax_enable_x64', True)", stacklevel=2)
    truths = {key: known_rows(f"series: the truth of {key}", x, rows) for key, x in (truth or {}).items()}
    given = {key: floats(key, x) for key, x in inputs.items()}
    return Recording(np.arange(float(rows)) if times is None else times, readings, given, truths, name)


class _Rooted(eqx.Module):
    """Noise of a fixed root, whose columns have the factors `sigma`: standard deviations, or one factor of all columns.

    `columns`: of the root, its entries by row.
    """

    sigma: Noise
    columns: tuple[tuple[tuple[int, float], ...], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def root(self, dt: Scalar) -> list[dict[int, Scalar]]:
        """The rows of a root of the covariance, by column."""
        rows: list[dict[int, Scalar]] = [{} for _ in range(self.size)]
        for j, column in enumerate(self.columns):
            for i, entry in column:
                rows[i][j] = times(entry, self.sigma.value[min(j, len(self.sigma.value) - 1)])
        return rows

    def entries(self, dt: Scalar) -> list[list[Scalar]]:
        """The covariance."""
        rows = self.root(dt)
        return [[total(a[j] * b[j] for j in sorted(a.keys() & b.keys())) for b in rows] for a in rows]


class _Function(eqx.Module):
    """Noise whose covariance is a function of `dt` and of tunable `numbers`."""

    numbers: dict[str, Noise]
    function: Callable[..., Any] = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def entries(self, dt: Scalar) -> list[list[Scalar]]:
        """The covariance."""
        numbers = {name: number.value for name, number in self.numbers.items()}
        array = jnp.atleast_2d(jnp.asarray(_called(partial(self.function, **numbers), dt)))
        return [[array[i, j] for j in range(self.size)] for i in range(self.size)]

    def root(self, dt: Scalar) -> list[dict[int, Scalar]]:
        """The rows of a root of the covariance, by column."""
        entries = self.entries(dt)
        upper = {(i, j): entries[i][j] for i, j in triangle(self.size)}
        factor = cholesky(upper, range(self.size), _SINGULAR)
        return [{j: factor[i, j] for j in range(i + 1)} for i in range(self.size)]


class _Motion(AbstractMotion):
    """x' = function(x, dt, inputs) + the noise `Q`; unchanged where no time passes."""

    Q: eqx.Module
    function: Callable[..., Any] = eqx.field(static=True)
    parts: tuple[tuple[str, int], ...] = eqx.field(static=True)

    @property
    def noise_dimension(self) -> int:
        return sum(length for _, length in self.parts)

    def step(self, state: Any, inputs: Inputs, dt: Scalar, w: Vector) -> Any:
        x = Vector(*(number for part in state for number in part))
        moved = self.function(x, dt, inputs)
        # An index beyond the end of a jax array is that of its last number.
        _fits("the state after a step", jnp.asarray(moved).shape, self.noise_dimension)
        rows = enumerate(self.Q.root(dt))  # type: ignore[attr-defined]
        noisy = [total([moved[i], *(times(a, w[j]) for j, a in row.items())]) for i, row in rows]
        return _state(self.parts, [jnp.where(dt > 0, a, b) for a, b in zip(noisy, x, strict=True)])


class _Sensor(AbstractSensor):
    """z = function(x, inputs) + the noise `R`, to which reported variances add."""

    R: eqx.Module
    function: Callable[..., Any] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    view_fields: tuple[str, ...] = eqx.field(static=True)  # type: ignore[misc]

    @property
    def channels(self) -> tuple[Channel, ...]:
        return tuple(Channel(f"z{k}", "1") for k in range(self.size))

    @property
    def reported(self) -> tuple[Channel, ...]:
        return tuple(Channel(f"variance_{k}", "1") for k in range(self.size))

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        parts = (getattr(view, name) for name in self.view_fields)
        predicted = self.function(Vector(*(number for part in parts for number in part)), inputs)
        _fits("a predicted measurement", jnp.asarray(predicted).shape, self.size)
        return [predicted[k] for k in range(self.size)]

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        noise = self.R.entries(1.0)  # type: ignore[attr-defined]
        for k, variance in enumerate(reading.reported):
            noise[k][k] = noise[k][k] + variance
        return correlated([z - p for z, p in zip(reading.values, predicted, strict=True)], noise, list(reading.seen))


class _Prior(AbstractStart):
    """A known belief at the first row, before its measurement."""

    known: ClassVar[bool] = True
    mean: tuple[float, ...] = eqx.field(static=True)
    upper: tuple[float, ...] = eqx.field(static=True)
    parts: tuple[tuple[str, int], ...] = eqx.field(static=True)

    def can_start(self, row: Row) -> Scalar:
        return row.valid

    def candidate(self, sensors: Mapping[str, AbstractSensor], row: Row) -> Any:
        return jnp.zeros_like(row.dt)

    def belief(self, candidate: Any, row: Row) -> Gaussian:
        mean, upper = ([x + candidate for x in numbers] for numbers in (self.mean, self.upper))
        return Gaussian(_state(self.parts, mean), tuple(upper))


def _tracker(
    step: Callable[..., Any], functions: Mapping[str, Callable[..., Any]], Q: Matrix, R: Any, size: int,
    x0: Sequence[float] | None, P0: Any, state: Mapping[str, int] | None, gains: Mapping[str, float],
) -> Tracker:  # fmt: skip
    parts = tuple((state or {"x": size}).items())
    mean = np.zeros(size) if x0 is None else floats("x0", x0)
    fits = np.isfinite(mean).all() and all(map(str.isidentifier, dict(parts)))
    if not fits or not size or sum(length for _, length in parts) != size or mean.shape != (size,):
        found = f"a state of {size} numbers with state = {dict(parts)} and x0 = {mean.tolist()}"
        raise UnusableInput(f"{found}; expected {size} each, named as variables")
    noises = R if isinstance(R, Mapping) else {SENSOR: R}
    if set(noises) != set(functions):
        raise UnusableInput(f"sensors {', '.join(functions)} and R of {', '.join(noises)}; expected the same names")
    names, sensors = tuple(part for part, _ in parts), dict[str, AbstractSensor]()
    for name, function in functions.items():
        noise = _noise(f"R of {name}", noises[name], None, "measurement noise")
        sensors[name] = _Sensor(R=noise, function=function, size=noise.size, view_fields=names)
    # Of functions it is not known how much a variance of the state counts in a reading.
    known = {name: gain for name, gain in gains.items() if gain and not isinstance(noises[name], tuple | Callable)}
    least = min([np.diag(np.atleast_2d(noises[name])).min() / gain for name, gain in known.items()], default=np.inf)
    most = RESOLVED * least if jax.dtypes.canonicalize_dtype(float) == np.float32 else np.inf
    # A smaller one would take `x0` for known: single precision begins rather with some rows that are too uncertain.
    diffuse = max(min(DIFFUSE, most), LEAST_DIFFUSE)
    cov = _covariance("P0", diffuse * np.eye(size) if P0 is None else P0, size)[0]
    if P0 is not None and np.diag(cov).max() > most:
        found = f"P0 has a variance of {np.diag(cov).max():g}, beside readings with one of {least:.2g}"
        fix = f"give at most {most:.2g}, or jax.config.update('jax_enable_x64', True)"
        warnings.warn(f"{found}: too far apart for single precision, first rows are too uncertain; {fix}", stacklevel=3)
    motion = _Motion(_noise("Q", Q, size, "process noise"), step, parts)
    start = _Prior(tuple(mean.tolist()), tuple(float(cov[i, j]) for i, j in triangle(size)), parts)
    return Tracker(motion, sensors, start, track_loss=TrackLossPolicy(np.inf, max_gap=np.inf))


def _noise(what: str, given: Matrix, size: int | None, role: Role) -> Any:
    """The noise of a covariance, as it is tuned."""
    function, numbers = given if isinstance(given, tuple) else (given, {})
    if callable(function):
        matrix, *_ = _covariance(what, function(1.0, **numbers), size)
        if role == "measurement noise" and not np.allclose(matrix, floats(what, function(2.0, **numbers)), 1e-9, 0.0):
            raise UnusableInput(f"{what} changes with dt; expected one R for all rows; give `series` a std by row")
        return _Function({name: Scale(x, "1", role) for name, x in numbers.items()}, function, len(matrix))
    matrix, eigenvalues, vectors = _covariance(what, given, size)
    n, some, regular = len(matrix), np.flatnonzero(np.diag(matrix)).tolist(), eigenvalues[0] > 0.0
    if role == "measurement noise" and not regular:
        raise UnusableInput(f"{what} = {matrix.tolist()} is singular; expected noise in every number of a reading")
    if np.count_nonzero(matrix) == len(some):
        return _Rooted(Scale(np.sqrt(np.diag(matrix)[some]), "1", role), tuple(((i, 1.0),) for i in some), n)
    if regular:
        return _Function({"covariance": Covariance(matrix, "1", role)}, lambda dt, covariance: covariance, n)
    roots = (vectors * np.sqrt(eigenvalues)).T[eigenvalues > 0.0]
    columns = tuple(tuple((i, float(x)) for i, x in enumerate(root) if x) for root in roots)
    return _Rooted(Scale(np.ones(1), "1", role), columns, n)


def _covariance(what: str, given: Any, size: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A covariance, its ascending eigenvalues, zero where it is singular, and eigenvectors; raises UnusableInput."""
    matrix = np.atleast_2d(floats(what, given))
    _fits(what, matrix.shape, *[size or len(matrix)] * 2)
    eigenvalues, vectors = np.linalg.eigh(np.nan_to_num(matrix))
    diagonal = np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0  # of other units
    zero = (1e-6 if getattr(given, "dtype", None) == np.float32 else _SINGULAR) * eigenvalues[-1] * (not diagonal)
    symmetric = np.allclose(matrix, matrix.T, rtol=1e-9, atol=zero)
    if not symmetric or not np.isfinite(matrix).all() or eigenvalues[0] < -zero:
        raise UnusableInput(f"{what} = {matrix.tolist()}; expected a symmetric covariance, positive semidefinite")
    return (matrix + matrix.T) / 2, np.where(eigenvalues > zero, eigenvalues, 0.0), vectors


def _fits(what: str, shape: tuple[int, ...], *expected: int | str) -> None:
    """Raises UnusableInput for a shape other than the `expected` one, in which a letter is any number."""
    if len(shape) != len(expected) or any(e not in (n, "m", "k") for n, e in zip(shape, expected, strict=True)):
        raise UnusableInput(f"{what} has shape {shape}; expected ({', '.join(map(str, expected))})")


def _product(what: str, matrix: Any, rows: int | str, columns: int | str = "k") -> Callable[..., list[Scalar]]:
    """The function of a vector and further arguments that multiplies by a matrix, or by what a function returns."""
    if callable(matrix):

        def varying(x: Sequence[Scalar], *arguments: Any) -> list[Scalar]:
            array = jnp.asarray(_called(matrix, *arguments))
            _fits(what, array.shape, rows, len(x))
            return [total(array[i, j] * v for j, v in enumerate(x)) for i in range(array.shape[0])]

        return varying
    array = np.atleast_2d(floats(what, matrix))
    _fits(what, array.shape, rows, columns)
    if not np.isfinite(array).all():
        raise UnusableInput(f"{what} = {array.tolist()}; expected finite numbers")
    # Zeros and ones cost nothing.
    entries = [{j: float(v) for j, v in enumerate(row) if v} for row in array]
    return lambda x, *_: [total(times(a, x[j]) for j, a in row.items()) for row in entries]


def _called(function: Callable[..., Any], *arguments: Any) -> Any:
    """The function of as many of the arguments as it takes; raises UnusableInput where NumPy's functions take them."""
    try:
        return function(*arguments[: _taken(function)])
    except jax.errors.TracerArrayConversionError as error:
        found = f"{getattr(function, '__name__', 'a function of Q or R')}: NumPy's functions of its arguments"
        raise UnusableInput(f"{found}; expected those of jax.numpy, as jnp.array([[dt**3 / 3, …]])") from error


def _taken(function: Callable[..., Any]) -> int:
    """How many arguments a function takes, without those that have a default, as a loop's own numbers in a lambda."""
    return sum(one.default is one.empty for one in inspect.signature(function).parameters.values())


def _refuse_unread(inputs: Inputs, of: str, words: str, *functions: tuple[Any, int]) -> None:
    """Raises UnusableInput for an input u where no function takes more than its number of other arguments."""
    if "u" in inputs and not any(callable(function) and _taken(function) > least for function, least in functions):
        raise UnusableInput(f"{of}: the series has an input u, but the tracker has {words}, or leave u out")


@lru_cache
def _kind(names: tuple[str, ...]) -> Any:
    # A class without a module is made anew where its states are unpickled.
    pickled = {"__slots__": (), "__reduce__": lambda state: (_remade, (names, tuple(state)))}
    return type("State", (namedtuple("State", names),), pickled)


def _remade(names: tuple[str, ...], parts: tuple[Any, ...]) -> Any:
    return _kind(names)(*parts)


def _state(parts: tuple[tuple[str, int], ...], numbers: Sequence[Scalar]) -> Any:
    """The state with these parts."""
    ends = np.cumsum([0, *(length for _, length in parts)])
    vectors = (Vector(*numbers[a:b]) for a, b in pairwise(ends))
    return _kind(tuple(name for name, _ in parts))(*vectors)
