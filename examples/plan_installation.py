"""Plan an installation: how accurate positions can be over a floor, and where anchors should stand.

python examples/plan_installation.py                # a hall of 20 m by 12 m with four anchors
python examples/plan_installation.py RECORDING      # the anchors of a recording folder, inside their box

The bound is that of Cramér and Rao for one range to each anchor: no unbiased estimate has a smaller root mean square
error. The gradient of its mean over the floor moves the anchors along the walls; nothing has to be recorded before.
"""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import trackwright as tw

SIGMA, HEIGHT = 0.1, 1.2
"""Standard deviation of a range, and the height of the tags, m; it is known to the tracker."""

SENSOR = tw.parts.RangeSensor(1, 1, SIGMA, 1.0, 1e6)


def bound(anchors, place):
    """The bound, m, of the horizontal position of a tag at `place` (2,), by the residuals of the tracker's sensor."""

    def whitened(at, anchor):
        inputs = {"anchors": anchor, "anchor": jnp.zeros(1), "height": jnp.asarray(HEIGHT)}
        state = tw.parts.Kinematic(tw.Vector(*at), tw.Vector(0.0 * at[0], 0.0 * at[1]))
        exact = jnp.linalg.norm(jnp.append(place, HEIGHT) - anchor)
        reading = tw.Reading([exact], [jnp.asarray(True)], ())
        residual = SENSOR.residual(reading, list(SENSOR.measure(state, inputs)))
        return jnp.stack(residual.whitened)

    H = jax.vmap(jax.jacfwd(whitened), (None, 0))(place, anchors).reshape(-1, 2)
    (a, b), (_, c) = H.T @ H
    return jnp.sqrt((a + c) / jnp.maximum(a * c - b * b, 1e-9))


@jax.jit
def over(anchors, places):
    """The bound at each of the places (k, 2)."""
    return jax.vmap(partial(bound, anchors))(places)


def on_walls(share, size, heights):
    """The anchors (n, 3), m, at shares of the way around a room of this size (2,)."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * size
    way = np.append(0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).sum(axis=1)))
    at = [jnp.interp(share % 1.0 * way[-1], way, corners[:, k]) for k in range(2)]
    return jnp.column_stack([*at, heights])


def placed(share, size, heights, places, steps=200, rate=0.02):
    """Shares of the way around the walls at which the mean bound is least, by the sign of its gradient."""

    def cost(share):
        return jnp.log(jnp.mean(over(on_walls(share, size, heights), places)))

    slope = jax.jit(jax.value_and_grad(cost))
    best, least = share, np.inf
    for step in range(steps):
        value, gradient = slope(share)
        best, least = (share, value) if value < least else (best, least)
        share = share - rate * (1.0 - step / steps) * jnp.sign(gradient)
    return best


if len(sys.argv) > 1:
    rig = tw.read(sys.argv[1]).rig
    before = np.array([*rig.anchors.values()])
    corner = before[:, :2].min(axis=0)
    before, size = before - np.append(corner, 0.0), np.ptp(before[:, :2], axis=0)
else:
    size, heights = np.array([20.0, 12.0]), np.array([2.6, 0.6, 2.6, 0.6])
    start = np.array([0.02, 0.07, 0.12, 0.17])  # along one wall, where the power is
    before = np.asarray(on_walls(start, size, heights))
x, y = (np.linspace(0.5, length - 0.5, n) for length, n in zip(size, (40, 24), strict=True))
places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
layouts = {"as planned": before}
if len(sys.argv) == 1:
    layouts["moved along the walls"] = np.asarray(on_walls(placed(start, size, heights, places), size, heights))

figure, panels = plt.subplots(1, len(layouts), figsize=(4.6 * len(layouts), 3.6), layout="constrained", squeeze=False)
means = {}
for axes, (name, anchors) in zip(panels[0], layouts.items(), strict=True):
    bounds = np.asarray(over(anchors, places))
    means[name] = float(bounds.mean())
    print(f"{name}: mean bound {100 * means[name]:.1f} cm, 95 % below {100 * np.quantile(bounds, 0.95):.1f} cm")
    shown = axes.pcolormesh(x, y, 100 * bounds.reshape(len(y), len(x)), vmin=5, vmax=40, cmap="viridis_r")
    axes.plot(*anchors[:, :2].T, "r^", clip_on=False)
    axes.set(title=f"{name}: {100 * means[name]:.1f} cm", xlabel="x (m)", ylabel="y (m)", aspect="equal")
figure.colorbar(shown, ax=panels, label="bound of the horizontal error (cm)")
figure.savefig("plan_installation.png", dpi=100)
