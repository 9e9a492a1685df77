"""The checks of motions and sensors name what is wrong with parts that break their contracts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trackwright as tw
from trackwright.trackers.conformance.parts import check_motion, check_sensor
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import AbstractMotion, Placed
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Residual, independent


def _fails(check_part, part, name, message):
    with pytest.raises(tw.BrokenContract, match=f"^{name}: (?s:.*){message}"):
        check_part(part, Placed(Vector(0.4, 0.7)))


class Walk(AbstractMotion):
    move: object = eqx.field(static=True)

    @property
    def noise_dimension(self):
        return 2

    def step(self, state, inputs, dt, w):
        return self.move(state.position, dt, w)

    def view(self, state):
        return state


@pytest.mark.parametrize(
    ("move", "check", "message"),
    [
        (lambda p, dt, w: Placed(p + w * 0.1), "zero interval", "dt = 0 changes the state; usual fix"),
        (lambda p, dt, w: p + w * dt, "state", r"returns Vector\(.*expected a state like the given one: Placed"),
        (lambda p, dt, w: Placed(p + w * dt if p[0] > 0 else p), "state", "TracerBoolConversionError"),
        (lambda p, dt, w: Placed(p + w * (dt * np.random.default_rng().normal())), "randomness", "other numbers when"),
        (lambda p, dt, w: Placed(p + w * dt * jnp.sqrt((p - p).dot(p) + 0.0 * w[0])), "finite", "is not finite at pos"),
        (lambda p, dt, w: Placed(Vector(p[0] + w[0] * dt, p[1] + jax.lax.stop_gradient(p[0]) * dt + w[1] * dt)),
         "derivatives", r"covariance of position\.[01] and position\.1 .* by difference quotients .*no stop_gradient"),
    ],
)  # fmt: skip
def test_a_broken_motion_is_named_with_what_is_wrong(move, check, message):
    _fails(check_motion, Walk(move), check, message)


class Ruler(AbstractSensor):
    """Both coordinates with sigmas of 0.1 and 0.3 m, whose residual a test breaks."""

    change: object = eqx.field(static=True)

    @property
    def channels(self):
        return Channel("x", "m"), Channel("y", "m")

    def measure(self, view, inputs):
        return list(view.position)

    def residual(self, reading, predicted):
        good = independent([z - p for z, p in zip(reading.values, predicted, strict=True)], [0.1, 0.3], reading.seen)
        return self.change(good, reading, predicted)


def _unmasked(good, reading, predicted):
    return good._replace(whitened=[(z - p) / 0.1 for z, p in zip(reading.values, predicted, strict=True)])


def _root(good, reading, predicted):
    return good._replace(whitened=[jnp.sign(w) * jnp.sqrt(jnp.abs(w)) for w in good.whitened])


@pytest.mark.parametrize(
    ("change", "check", "message"),
    [
        (lambda g, z, p: g._replace(log_scale=0.0 * g.log_scale), "density", "density of x integrates to .* usual fix: log_scale"),
        (lambda g, z, p: g._replace(dof=jnp.asarray(4.0)), "density", "density of x integrates to"),
        (lambda g, z, p: g._replace(whitened=[w * 2.0 for w in g.whitened]), "density", "density of x integrates to"),
        (_unmasked, "mask", "reads a masked channel: whitened"),
        (lambda g, z, p: g._replace(log_scale=g.log_scale + 0.1), "mask", "nis_dof 0, log_scale 0.1 of seen"),
        (
            lambda g, z, p: g._replace(log_scale=g.log_scale + 0.1 * z.values[1]),
            "mask",
            "reads a masked channel",
        ),
        (lambda g, z, p: g._replace(nis_dof=g.nis_dof + 1.0), "residual", "has nis_dof 3, expected at most"),
        (lambda g, z, p: g._replace(whitened=g.whitened[:1]), "residual", "has 1 whitened numbers, expected one per channel, 2"),
        (lambda g, z, p: g._replace(whitened=[w + 1.0 for w in g.whitened]), "residual", "equal to the prediction"),
        (_root, "finite", "derivative of Ruler.residual of a reading off by 0 is not finite at x"),
        (lambda g, z, p: g._replace(whitened=[jnp.sinh(w) for w in g.whitened]), "finite", r"off by 1e\+06 is not finite at x"),
        (lambda g, z, p: Residual(g.whitened, g.log_scale, 2.0), "mask", "nis_dof 2"),
        (
            lambda g, z, p: independent([v - jax.lax.stop_gradient(q) for v, q in zip(z.values, p, strict=True)], [0.1, 0.3], z.seen),
            "derivatives",
            r"whitened x by position\.0 is -?0, by difference quotients -10",
        ),
    ],
    ids=[
        "no scale", "scale of another law", "half the sigma", "mask ignored", "scale of nothing", "scale by hidden value",
        "count", "too few", "biased", "infinite slope", "overflow", "constant count", "cut derivative",
    ],
)  # fmt: skip
def test_a_broken_sensor_is_named_with_what_is_wrong(change, check, message):
    _fails(check_sensor, Ruler(change), check, message)
