"""Phase sensors of a planar array and the default array: predicted phases, and the residual with an unknown offset.

The paper (Will et al. 2020, equations 8–17) uses all 28 wrapped differences with their singular 28 × 28 noise
covariance. With its pseudo-inverse this equals n centred phases with independent noise, the form used here; the two
differ only where a difference wraps: see `centred`, `pairwise` and docs/papers.md.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackwright.trackers.core.errors import require
from trackwright.trackers.core.model.algebra import Scalar, Vector, compute_once, inverse_or_zero, total
from trackwright.trackers.core.model.inputs import HEIGHT, AnyArray, Input, Inputs
from trackwright.trackers.core.model.motion import Noise, as_scale
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.model.sensor import (
    LOG_2PI,
    AbstractSensor,
    Channel,
    Reading,
    Residual,
    position_in_space,
)
from trackwright.trackers.core.model.state import wrap
from trackwright.trackers.core.model.tunable import Real

CLEAR = 1e-5
"""Share of an array's scatter below which antennas are on a line or one: the rounding of single precision is less."""


def centred(reading: Reading, predicted: Sequence[Scalar], sigma_p: Scalar) -> Residual:
    """The default form: differences less their circular mean, wrapped and centred.

    Rank n − 1 for n antennas seen; the density is over the n − 1 differences to one antenna.
    """
    seen, n, nis_dof = _counts(reading)
    differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
    # A constant subtracted from all antennas is removed by the centring below, so its derivative may be left out.
    common = circular_mean([jax.lax.stop_gradient(d) for d in differences], seen, n)
    wrapped = [wrap(d - common) for d in differences]
    centre = compute_once(seen.dot(wrapped) / n)
    residuals = [s * (d - centre) for s, d in zip(seen, wrapped, strict=True)]
    # The paper's differences wrap, and the two forms differ, exactly if two residuals differ by more than half a turn.
    widest = reduce(jnp.maximum, residuals) - reduce(jnp.minimum, residuals)
    return _scaled(residuals, n, nis_dof, sigma_p, widest > jnp.pi)


def pairwise(reading: Reading, predicted: Sequence[Scalar], sigma_p: Scalar) -> Residual:
    """The paper's form (8)–(17): all n(n − 1)/2 differences wrapped, then averaged per antenna, Dᵀν/n."""
    seen, n, nis_dof = _counts(reading)
    differences = [z - p for z, p in zip(reading.values, predicted, strict=True)]
    means = [seen.dot([wrap(d - e) for e in differences]) / n for d in differences]
    residuals = [s * mean for s, mean in zip(seen, means, strict=True)]
    pairs = [(i, j) for i in range(len(seen)) for j in range(i)]
    # If nothing wraps, the difference of two residuals is the wrapped difference itself.
    gaps = [jnp.abs(wrap(differences[i] - differences[j]) - residuals[i] + residuals[j]) for i, j in pairs]
    wrapped = total(
        jnp.where((g > 1.0) & reading.seen[i] & reading.seen[j], 1, 0) for g, (i, j) in zip(gaps, pairs, strict=True)
    )
    return _scaled(residuals, n, nis_dof, sigma_p, wrapped > 0)


def _counts(reading: Reading) -> tuple[Vector, Scalar, Scalar]:
    """The mask of seen antennas as 0 or 1, their number (at least 1), and the rank of their centred phases."""
    one = jnp.ones_like(reading.values[0])
    seen = Vector.of(jnp.where(s, one, 0.0) for s in reading.seen)
    n = jnp.maximum(compute_once(total(seen)), 1.0)
    return seen, n, n - 1.0


def _scaled(residuals: Sequence[Scalar], n: Scalar, nis_dof: Scalar, sigma_p: Scalar, wrapped: Scalar) -> Residual:
    log_scale = -nis_dof * (jnp.log(sigma_p) + 0.5 * LOG_2PI) - 0.5 * jnp.log(n)
    return Residual([r / sigma_p for r in residuals], log_scale, nis_dof, wrapped)


class AbstractPhaseSensor(AbstractSensor):
    """Phases of n antennas with an unknown common offset per row and a constant offset per antenna."""

    sigma_p: eqx.AbstractVar[Noise]
    offsets: eqx.AbstractVar[Noise]
    paper_form: eqx.AbstractVar[bool]

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One wrapped phase per antenna, rad."""
        return tuple(Channel(f"phase_{i + 1}", "rad", True) for i in range(np.shape(self.offsets.value)[0]))

    def residual(self, reading: Reading, predicted: Sequence[Scalar]) -> Residual:
        """The n centred phases over `sigma_p`, by the default form or the paper's."""
        return (pairwise if self.paper_form else centred)(reading, predicted, self.sigma_p.value)


class AbstractPlanePhases(AbstractPhaseSensor):
    """Phases of a plane wave: equation (9) for each antenna.

    `sigma_p`: phase noise, rad. `offsets`: (n,) rad, residual calibration errors. `wavenumbers`: (n, 2), 2π/λ times the
    antennas' x, y.
    """

    sigma_p: Noise
    offsets: Noise
    wavenumbers: Any
    paper_form: bool = eqx.field(static=True)

    def __init__(self, station: Station, sigma_p: float | Noise, paper_form: bool):
        antennas, wavelength = array_of(station)
        self.sigma_p, self.paper_form = as_scale(sigma_p, "rad", "measurement noise"), paper_form
        self.wavenumbers = 2 * np.pi / wavelength * antennas
        self.offsets = Real(np.zeros(len(antennas)), "rad", typical=0.1)

    @abstractmethod
    def direction_cosines(self, view: Any) -> tuple[Scalar, Scalar]:
        """The components along the array's x and y axes of the unit vector from the station to the tag."""

    def residual_near(self, view: Any, reading: Reading, inputs: Inputs) -> Callable[[Any], Residual]:
        """The n centred phases r as two channels and a rest, since they are linear in the two direction cosines.

        With K the n × 2 wavenumbers less their mean over the antennas seen and KᵀK = LLᵀ, the channels are L⁻¹Kᵀr.
        """
        if self.paper_form:
            return super().residual_near(view, reading, inputs)
        whole, at = self.residual(reading, list(self.measure(view, inputs))), self.direction_cosines(view)
        (seen, n, _), sigma, r = _counts(reading), self.sigma_p.value, Vector.of(whole.whitened)
        x, y = (column - column.mean() for column in self.wavenumbers.T)

        def root(square: Scalar) -> Scalar:
            clear = square > CLEAR * (x * x + y * y).sum()
            return compute_once(jnp.where(clear, jnp.sqrt(jnp.where(clear, square, 1.0)), 0.0))

        xx, xy, yy = (seen.dot(a * b) - seen.dot(a) * seen.dot(b) / n for a, b in ((x, x), (x, y), (y, y)))
        of_x = root(xx)
        mixed = compute_once(xy * inverse_or_zero(of_x))
        of_y = root(yy - mixed * mixed)
        first = compute_once(r.dot(x) * inverse_or_zero(of_x))
        second = compute_once((r.dot(y) - mixed * first) * inverse_or_zero(of_y))
        whole = whole._replace(rest=jnp.maximum(r.dot(r) - first * first - second * second, 0.0))

        def near(other: Any) -> Residual:
            u, v = (now - before for now, before in zip(self.direction_cosines(other), at, strict=True))
            return whole._replace(whitened=[first - (of_x * u + mixed * v) / sigma, second - of_y * v / sigma])

        return near

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        x, y = self.direction_cosines(view)
        return [k[0] * x + k[1] * y + offset for k, offset in zip(self.wavenumbers, self.offsets.value, strict=True)]


class PlanePhases(AbstractPlanePhases):
    """Phases of a plane wave from azimuth and elevation in the array frame; attributes as in `AbstractPlanePhases`."""

    view_fields: ClassVar[tuple[str, ...]] = ("azimuth", "elevation")

    def __init__(self, station: Station, sigma_p: float | Noise = 0.3, paper_form: bool = False):
        super().__init__(station, sigma_p, paper_form)

    def direction_cosines(self, view: Any) -> tuple[Scalar, Scalar]:
        return compute_once((jnp.sin(view.azimuth) * jnp.cos(view.elevation), jnp.sin(view.elevation)))


class InPlanePhases(AbstractPlanePhases):
    """Phases of a plane wave in the plane of the array, from the angle `view.heading` about its z axis.

    For flat arrays with beacons at the array's height, where azimuth and elevation about the boresight are singular.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("heading",)

    def __init__(self, station: Station, sigma_p: float | Noise = 0.5, paper_form: bool = False):
        super().__init__(station, sigma_p, paper_form)

    def direction_cosines(self, view: Any) -> tuple[Scalar, Scalar]:
        return jnp.cos(view.heading.angle), jnp.sin(view.heading.angle)


class SphericalPhases(AbstractPhaseSensor):
    """Phases of a spherical wave from `view.position`: −2π/λ times the true distance, no plane-wave approximation.

    `sigma_p`, `offsets` as in `AbstractPlanePhases`. `antennas`: (n, 3) m from `origin` (3,) m, world axes.
    """

    view_fields: ClassVar[tuple[str, ...]] = ("position",)

    sigma_p: Noise
    offsets: Noise
    antennas: Any
    origin: Any
    array_from_world: Any
    wavenumber: Any
    paper_form: bool = eqx.field(static=True)

    def __init__(self, station: Station, sigma_p: float | Noise = 0.3, paper_form: bool = False):
        _, wavelength = array_of(station)
        self.sigma_p = as_scale(sigma_p, "rad", "measurement noise")
        self.antennas = station.antenna_positions() - station.position
        self.offsets = Real(np.zeros(len(self.antennas)), "rad", typical=0.1)
        self.origin = np.asarray(station.position, float)
        self.array_from_world = station.world_from_array().T
        self.wavenumber = np.asarray(2 * np.pi / wavelength)
        self.paper_form = paper_form

    @property
    def inputs(self) -> tuple[Input, ...]:
        return (HEIGHT,)

    def measure(self, view: Any, inputs: Inputs) -> list[Scalar]:
        to_tag = Vector.of(p - o for p, o in zip(position_in_space(view.position, inputs), self.origin, strict=True))
        distance = to_tag.norm()
        phases = []
        for antenna, offset in zip(self.antennas, self.offsets.value, strict=True):
            a = Vector.of(antenna)
            # |p| − |p − a| without subtracting two distances: accurate to under 1 mrad in single precision.
            shorter = (2.0 * to_tag.dot(a) - a.dot(a)) / (distance + (to_tag - a).norm())
            phases.append(self.wavenumber * shorter + offset)
        return phases


def array_of(station: Station) -> tuple[np.ndarray, float]:
    """The antennas' places (n, 2) and the wavelength, m."""
    if station.antennas is None or station.wavelength is None:
        raise ValueError("phases need a station with antennas and a wavelength; this one reports angles")
    return np.asarray(station.antennas, float), float(station.wavelength)


def require_array(function: str, station: Any) -> None:
    """Refuse anything but a station with antennas as the station of a tracker's constructor."""
    ready = isinstance(station, Station) and station.antennas is not None and station.wavelength is not None
    require(ready, function, station, "a station with antennas and a wavelength, as rig.stations['1']")


def require_arrays(function: str, stations: Any) -> None:
    """Refuse anything but stations with antennas by name as the stations of a tracker's constructor."""
    named = isinstance(stations, Mapping) and len(stations) > 0
    require(named, function, stations, f"stations with antennas by name, as {function}(rig.stations)")
    for name, station in stations.items():
        require_array(f"{function}: station {name}", station)


# Least-squares polynomials in t², t = angle/π, on [−1, 1]: sin πt = t(1 − t²)·Σ SINE t²ᵏ (error 3e-9) and
# cos πt = Σ COSINE t²ᵏ (error 1e-8); XLA's sin and cos cost ten times as much on a CPU.
SINE = (
    3.141592645271753,
    -2.026119481251057,
    0.5240362466319017,
    -0.07518748136549892,
    0.006860405614362804,
    -0.0003860171874991249,
)
COSINE = (
    0.9999999890398765,
    -4.93480112425251,
    4.0586948357568255,
    -1.335158409305255,
    0.23502977020497642,
    -0.025358950345296026,
    0.0015938995965745699,
)
# atan x ≈ x·Σ ARC x²ᵏ on [0, 1], error 2e-6 rad (Abramowitz and Stegun 1964, 4.4.49, refitted).
ARC = (0.99997726, -0.33262347, 0.19354346, -0.11643287, 0.05265332, -0.01172120)


def polynomial(coefficients: Sequence[float], x: Scalar) -> Scalar:
    """Σ cₖ xᵏ by Horner's rule."""
    result: Scalar = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        result = c + x * result
    return result


def circular_mean(angles: Sequence[Scalar], seen: Vector | Sequence[Scalar], count: Scalar) -> Scalar:
    """The direction of Σ exp(iθ) over the angles seen, rad, in (−π, π], to 1e-5 rad.

    It only decides which differences wrap, so this accuracy suffices. `count`: the number seen, at least 1.
    """
    turns = [a * (1.0 / jnp.pi) for a in angles]
    turns = [t - 2.0 * jnp.round(0.5 * t) for t in turns]
    squares = [t * t for t in turns]
    # The divisions do not change the angle, but XLA never duplicates one, so that all antennas share both sums.
    sine = total(s * t * (1.0 - q) * polynomial(SINE, q) for s, t, q in zip(seen, turns, squares, strict=True)) / count
    cosine = total(s * polynomial(COSINE, q) for s, q in zip(seen, squares, strict=True)) / count
    return compute_once(arctangent(sine, cosine))


def arctangent(sine: Scalar, cosine: Scalar) -> Scalar:
    """The angle of the point (cosine, sine), rad, to 1e-5; 0 at the origin."""
    a, b = jnp.abs(sine), jnp.abs(cosine)
    large = jnp.maximum(a, b)
    ratio = jnp.minimum(a, b) / jnp.where(large > 0, large, 1.0)
    angle = ratio * polynomial(ARC, ratio * ratio)
    angle = jnp.where(a > b, jnp.pi / 2 - angle, angle)
    angle = jnp.where(cosine < 0, jnp.pi - angle, angle)
    return jnp.where(sine < 0, -angle, angle)


SPEED_OF_LIGHT = 299_792_458.0  # in vacuum, m/s

DEFAULT_WAVELENGTH = SPEED_OF_LIGHT / 24e9  # of the paper's 24 GHz beacon, m

DEFAULT_ANTENNAS = np.array(
    [
        [-0.02194, 0.00592],
        [-0.01902, -0.01740],
        [0.02975, -0.01795],
        [0.01168, -0.02000],
        [-0.01878, -0.00221],
        [-0.02975, 0.02000],
        [0.01432, -0.01224],
        [-0.01018, -0.00996],
    ]
)
"""Eight antennas within ±4 cm × ±2 cm, x and y in m, in the order of antennas 1 to 8 of the paper.

The figure with the true positions is lost. These are fitted: the bounds of the five antenna sets of Table 1 have the
ratios of the printed errors; among the many such layouts this one has low ambiguity, found by
`experiments/lab/papers/will_2020/_work_stand.py`.
"""


def boresight_bounds(antennas: AnyArray, sigma_p: float = 1.0) -> np.ndarray:
    """Cramér–Rao bounds (…, 2), rad, of azimuth and elevation at boresight from one row of phases of one array.

    `antennas` (..., n, 2) in m, `sigma_p` the phase noise in rad. One unknown common offset leaves the information
    G' (I - 11'/n) G / sigma_p², with G = 2 pi / wavelength (the default) times the positions: the scatter
    about their centroid.
    """
    centred = antennas - antennas.mean(axis=-2, keepdims=True)
    x, y = centred[..., 0], centred[..., 1]
    xx, yy, xy = (x * x).sum(-1), (y * y).sum(-1), (x * y).sum(-1)
    variances = np.stack([yy, xx], axis=-1) / (xx * yy - xy * xy)[..., None]
    return sigma_p * DEFAULT_WAVELENGTH / (2 * np.pi) * np.sqrt(variances)
