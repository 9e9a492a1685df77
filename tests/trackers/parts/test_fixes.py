"""Fixes whose device reports its own standard deviations."""

import equinox as eqx
import numpy as np

from trackwright.trackers.core.model.sensor import Reading
from trackwright.trackers.core.model.tunable import Scale, freeze
from trackwright.trackers.parts.fixes import FixSensor


def test_a_reported_standard_deviation_counts_by_its_scale_beside_the_sensors_own():
    sensor = eqx.tree_at(lambda s: s.reported_std_scale, FixSensor(0.3, 1.2), Scale(2.0))
    reading = Reading((1.0, -0.5, 2.0), (True, True, True), (0.2**2, 0.2**2, 0.25**2))
    whitened = freeze(sensor).residual(reading, [0.0, 0.0, 0.0]).whitened
    # Twice 0.2 m beside 0.3 m are 0.5 m, twice 0.25 m beside 1.2 m are 1.3 m.
    np.testing.assert_allclose([float(x) for x in whitened], [2.0, -1.0, 2.0 / 1.3], rtol=1e-6)
