"""The contract checks name what is wrong with parts that break their contracts."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from trackwright.sim.stations import work_station
from trackwright.trackers.aoa.beam import Beam
from trackwright.trackers.aoa.phases import PlanePhases
from trackwright.trackers.core.model.algebra import Vector
from trackwright.trackers.core.model.motion import (
    AbstractMotion,
    Placed,
)
from trackwright.trackers.core.model.sensor import AbstractSensor, Channel, Residual, independent
from trackwright.trackers.core.run.checks import BrokenContract, check_motion, check_sensor


def test_the_papers_form_is_no_density_over_all_phases_of_three_antennas():
    # Phases a third of a turn apart all wrap and average to zero: their whitened residual is zero.
    station = next(iter(work_station(work_station().stations["1"].antennas[:4]).stations.values()))
    with pytest.raises(BrokenContract, match="integrates to 1.8"):
        check_sensor(PlanePhases(station, 0.3, paper_form=True), Beam(0.1, 0.2, 0.3, 0.4))


class Walk(AbstractMotion):
    """A motion whose step a test breaks."""

    move: object = eqx.field(static=True)

    @property
    def noise_dimension(self):
        return 2

    def step(self, state, inputs, dt, w):
        return self.move(state.position, dt, w)

    def view(self, state):
        return state


@pytest.mark.parametrize(
    ("move", "message"),
    [
        (lambda p, dt, w: Placed(p + w * 0.1), r"dt = 0 changes position\.[01] by .*whatever the noise"),
        (lambda p, dt, w: Placed(p * jnp.exp(dt) * 1.0000001), "dt = 0 changes"),
        (lambda p, dt, w: p + w * dt, "returns Vector with shapes .*expected a state like"),
        (lambda p, dt, w: Placed(p + w * dt if p[0] > 0 else p), "cannot be traced"),
        (lambda p, dt, w: Placed(p + w * (dt * np.random.default_rng().normal())), "other numbers when traced again"),
        (
            lambda p, dt, w: Placed(p + w * dt * jnp.sqrt((p - p).dot(p))),
            "derivative of Walk.step at dt = 0.0 s is not finite at pos",
        ),
        (
            lambda p, dt, w: Placed(p + w * (jnp.sin(dt) / dt * dt)),
            "Walk.step at dt = 0.0 s is not finite|dt = 0 changes",
        ),
    ],
    ids=["noise", "drift", "another kind", "if", "random", "root of zero", "division by dt"],
)
def test_a_broken_motion_is_named_with_what_is_wrong(move, message):
    with pytest.raises(BrokenContract, match=message):
        check_motion(Walk(move), Placed(Vector(0.4, 0.7)))


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


def test_a_sound_sensor_of_ones_own_passes():
    check_sensor(Ruler(lambda good, reading, predicted: good), Placed(Vector(0.4, 0.7)))


def _unmasked(good, reading, predicted):
    return good._replace(whitened=[(z - p) / 0.1 for z, p in zip(reading.values, predicted, strict=True)])


def _root(good, reading, predicted):
    return good._replace(whitened=[jnp.sign(w) * jnp.sqrt(jnp.abs(w)) for w in good.whitened])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda g, z, p: g._replace(log_scale=0.0 * g.log_scale), "integrates to .* expected 1; usual fix: log_scale"),
        (lambda g, z, p: g._replace(dof=jnp.asarray(4.0)), "integrates to"),
        (lambda g, z, p: g._replace(whitened=[w * 2.0 for w in g.whitened]), "integrates to 0.5 over x"),
        (_unmasked, "expected 0 for a masked channel"),
        (lambda g, z, p: g._replace(log_scale=g.log_scale + 0.1), "no channel seen has nis_dof 0 and log_scale 0.1"),
        (lambda g, z, p: g._replace(log_scale=g.log_scale + 0.1 * z.values[1]), "expected 0 and 0|changes with the value"),
        (lambda g, z, p: g._replace(nis_dof=g.nis_dof + 1.0), "counts 3 numbers"),
        (lambda g, z, p: g._replace(whitened=g.whitened[:1]), "has 1 whitened numbers, expected one per channel, 2"),
        (lambda g, z, p: g._replace(whitened=[w + 1.0 for w in g.whitened]), "equal to the prediction"),
        (_root, "derivative of Ruler.residual of a reading off by 0 is not finite at x"),
        (lambda g, z, p: g._replace(whitened=[jnp.sinh(w) for w in g.whitened]), r"off by 1e\+06 is not finite at x"),
        (lambda g, z, p: Residual(g.whitened, g.log_scale, 2.0), "counts 2 numbers where|nis_dof 2"),
    ],
    ids=[
        "no scale", "scale of another law", "half the sigma", "mask ignored", "scale of nothing", "scale by hidden value",
        "count", "too few", "biased", "infinite slope", "overflow", "constant count",
    ],
)  # fmt: skip
def test_a_broken_sensor_is_named_with_what_is_wrong(change, message):
    with pytest.raises(BrokenContract, match=message):
        check_sensor(Ruler(change), Placed(Vector(0.4, 0.7)))


def test_a_motion_that_reads_a_field_that_the_state_lacks_is_named_with_those_it_has():
    class Typing(Walk):
        def step(self, state, inputs, dt, w):
            return Placed(state.pos + w * dt)

    with pytest.raises(BrokenContract, match=r"Typing\.step reads 'pos' of the state, a Placed, which has position"):
        check_motion(Typing(None), Placed(Vector(0.4, 0.7)))


def test_a_sensor_that_predicts_too_few_channels_is_named():
    class Short(Ruler):
        def measure(self, view, inputs):
            return [view.position[0]]

    with pytest.raises(
        BrokenContract, match=r"Short\.measure returns numbers of shapes \[\(\)\], expected 2 scalars: x, y"
    ):
        check_sensor(Short(lambda good, reading, predicted: good), Placed(Vector(0.4, 0.7)))


def test_a_sensor_that_reads_a_field_that_the_view_lacks_is_named_with_those_it_has():
    class Typing(Ruler):
        def measure(self, view, inputs):
            return list(view.pos)

    class Broken(Ruler):
        def measure(self, view, inputs):
            return [np.pie, view.position[1]]

    sound = lambda good, reading, predicted: good  # noqa: E731
    with pytest.raises(
        BrokenContract, match=r"Typing\.measure reads 'pos' of the view, a Placed, which has .*position"
    ):
        check_sensor(Typing(sound), Placed(Vector(0.4, 0.7)))

    class Lettered(Ruler):
        def measure(self, view, inputs):
            return [view.position.x, view.position.y]

    by_number = r"expected its components by number, \[0\] to \[1\]"
    with pytest.raises(BrokenContract, match=rf"Lettered\.measure reads 'x' of a vector; {by_number}"):
        check_sensor(Lettered(sound), Placed(Vector(0.4, 0.7)))
    # A slip of the sensor's own stays what it is.
    with pytest.raises(AttributeError, match="pie"):
        check_sensor(Broken(sound), Placed(Vector(0.4, 0.7)))
