"""A planar antenna array and what it measures: phases with one unknown common offset, in two forms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from trackers.core.algebra import Scalar, Vector, total
from trackers.core.motion import AbstractMotion, Noise
from trackers.core.sensor import LOG_2PI, AbstractSensor, Channel, Reading, Residual
from trackers.core.state import wrap
from trackers.core.tunable import Real, Scale


class PhaseSensor(AbstractSensor):
    sigma_p: Noise
    offsets: Noise
    antennas: Any  # (n, 2) in units of radians of phase: 2 pi p / lambda

    @property
    def channels(self):
        return tuple(Channel(f"phase_{i + 1}", "rad", True) for i in range(self.antennas.shape[0]))

    def measure(self, view, inputs):
        u = jnp.sin(view.azimuth) * jnp.cos(view.elevation)
        v = jnp.sin(view.elevation)
        return [k[0] * u + k[1] * v + self.offsets.value[i] for i, k in enumerate(self.antennas)]

    def residual(self, reading, predicted):
        return centred(reading, predicted, self.sigma_p.value)


def centred(reading, predicted, sigma):
    seen = [jnp.where(s, 1.0, 0.0) for s in reading.seen]
    n = total(seen)
    per = 1.0 / jnp.maximum(n, 1.0)
    raw = [z - p for z, p in zip(reading.values, predicted)]
    still = [jax.lax.stop_gradient(d) for d in raw]
    turn=[d*(1/jnp.pi) for d in still]; turn=[t-2*jnp.round(t*.5) for t in turn]
    import os
    def sp(t):
        q=t*t
        return t*(1-q)*(3.141593+q*(-2.0261+q*(0.5240+q*(-0.0753+q*.0061))))
    def cp(t):
        q=t*t
        return 1+q*(-4.9348+q*(4.0587+q*(-1.3352+q*(0.2353+q*(-.0258+q*.0018)))))
    n1=jnp.maximum(n,1.0); S=total(s * sp(d) for s, d in zip(seen, turn))/n1; Cc=total(s * cp(d) for s, d in zip(seen, turn))/n1
    if os.environ.get('TAN'):
        mean=jnp.arctan2(S,Cc)
    else:
        a=jnp.abs(S);b=jnp.abs(Cc); lo=jnp.minimum(a,b);hi=jnp.maximum(a,b); x=lo/jnp.where(hi>0,hi,1.); q=x*x
        r=x*(0.99997726+q*(-0.33262347+q*(0.19354346+q*(-0.11643287+q*(0.05265332+q*-0.01172120)))))
        r=jnp.where(a>b,jnp.pi/2-r,r); r=jnp.where(Cc<0,jnp.pi-r,r); r=(r*(1.+hi))/(1.+hi) if os.environ.get('SQ') else r; mean=jnp.where(S<0,-r,r)
    BAR=os.environ.get('BAR','')
    bar=lambda c,x: jax.lax.optimization_barrier(x) if c in BAR else x
    mean=bar('m',mean)
    wrapped = [wrap(d - mean) for d in raw]
    wrapped=bar('w',wrapped)
    centre = total(s * d for s, d in zip(seen, wrapped)) / jnp.maximum(n,1.0)
    res = [s * (d - centre) for s, d in zip(seen, wrapped)]
    dof = jnp.maximum(n - 1.0, 0.0)
    ls = -dof * (jnp.log(sigma) + 0.5 * LOG_2PI) - 0.5 * jnp.log(jnp.maximum(n, 1.0))
    hi = res[0]; lo = res[0]
    for r in res: hi = jnp.maximum(hi, r); lo = jnp.minimum(lo, r)
    return Residual([r / sigma for r in res], ls, dof, hi - lo > jnp.pi)


class BeamState(NamedTuple):
    azimuth: Scalar
    elevation: Scalar
    azimuth_rate: Scalar
    elevation_rate: Scalar


class BeamMotion(AbstractMotion):
    sigma_a: Noise

    @property
    def noise_dimension(self):
        return 2

    def step(self, state, inputs, dt, w):
        a = w * (self.sigma_a.value)
        h = 0.5 * dt * dt
        return BeamState(state.azimuth + state.azimuth_rate * dt + a[0] * h, state.elevation + state.elevation_rate * dt + a[1] * h, state.azimuth_rate + a[0] * dt, state.elevation_rate + a[1] * dt)

    def view(self, state):
        return state
