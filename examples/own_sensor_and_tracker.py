"""A sensor and a tracker of your own: a cabin in its shaft, by a barometer and the distance to a beacon.

A motion is one function, a sensor two. Filter, gradient, tuning and metrics follow from them: docs/extending.md.

python examples/own_sensor_and_tracker.py
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import trackwright as tw


class Lift(NamedTuple):
    """A cabin in its shaft: height in m, speed in m/s."""

    height: Any
    speed: Any


class Hoisted(tw.AbstractMotion):
    """Speed drifts by white acceleration, m/s²/√Hz."""

    sigma_a: tw.Scale
    noise_dimension = 1

    def step(self, state, inputs, dt, w):
        kick = self.sigma_a.value * jnp.sqrt(dt) * w[0]
        return Lift(state.height + state.speed * dt + kick * dt / 2, state.speed + kick)

    def view(self, state):
        return state


class ToBeacon(tw.AbstractSensor):
    """The distance, m, to a beacon beside the shaft: how far away the cabin is, but not whether above or below."""

    view_fields = ("height",)
    channels = (tw.Channel("distance", "m"),)
    beacon: Any
    sigma: tw.Scale

    def measure(self, view, inputs):
        aside, height = self.beacon
        return [jnp.hypot(aside, view.height - height)]

    def residual(self, reading, predicted):
        return tw.independent([reading.values[0] - predicted[0]], [self.sigma.value], reading.seen)


class Barometer(tw.AbstractSensor):
    """The height, m, by air pressure."""

    view_fields = ("height",)
    channels = (tw.Channel("height", "m"),)
    sigma: tw.Scale

    def measure(self, view, inputs):
        return [view.height]

    def residual(self, reading, predicted):
        return tw.independent([reading.values[0] - predicted[0]], [self.sigma.value], reading.seen)


class AtTheFirstReading(tw.AbstractStart):
    """At rest, where the barometer says."""

    def can_start(self, row):
        return row.readings["barometer"].seen[0]

    def candidate(self, sensors, row):
        return row.readings["barometer"].values[0]

    def belief(self, candidate, row):
        return tw.Gaussian(Lift(candidate, 0.0 * candidate), tw.diagonal([1.0**2, 1.0**2], candidate))


BEACON = np.array([0.8, 12.0])
motion = Hoisted(tw.Scale(1.0, "m/s^2/sqrt(Hz)", "process noise"))
sensors = {
    "barometer": Barometer(tw.Scale(0.3, "m", "measurement noise")),
    "beacon": ToBeacon(BEACON, tw.Scale(0.3, "m", "measurement noise")),
}
# What is broken is named, with the usual fix.
tw.check_motion(motion, Lift(3.0, 0.5))
for sensor in sensors.values():
    tw.check_sensor(sensor, Lift(3.0, 0.5))
tracker = tw.Tracker(motion, sensors, AtTheFirstReading())

rng = np.random.default_rng(2)
times = np.arange(0.0, 60.0, 0.2)
height = 10 + 8 * np.sin(times / 9) + 2 * np.sin(times / 2.5)
pressure = (height + 0.5 * rng.normal(size=len(times)))[:, None]
distance = (np.hypot(BEACON[0], height - BEACON[1]) + 0.05 * rng.normal(size=len(times)))[:, None]
near = distance < 6.0  # the beacon is heard nearby
readings = {"barometer": tw.Readings(pressure, np.ones_like(near)), "beacon": tw.Readings(distance, near)}
ride = tw.Recording(times, readings, name="ride")

# Both noise levels are wrong; the likelihood of the readings finds them without truth.
result = tw.fit(tracker, ride, "nll", tune=("sensors.*.sigma", "motion.sigma_a"))
print(result)
estimates = result.tracker.run(ride)
error = np.asarray(estimates.mean.height) - height
print(f"error {error.std():.3f} m, of the barometer alone {(pressure[:, 0] - height).std():.3f} m")

figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
sigma = np.asarray(estimates.sigmas["height"])
axes.fill_between(times, -3 * sigma, 3 * sigma, alpha=0.2, label="± 3 σ reported")
axes.plot(times, pressure[:, 0] - height, ".", color="0.7", markersize=3, label="barometer")
axes.plot(times, error, label="tracked")
axes.plot(times[near[:, 0]], np.full(near.sum(), -1.9), "k|", markersize=5, label="beacon heard")
axes.set(xlabel="time (s)", ylabel="error of the height (m)", ylim=(-2.2, 2.6))
axes.legend(ncols=4, loc="upper center", fontsize=8)
figure.savefig("own_sensor_and_tracker.png", dpi=100)
