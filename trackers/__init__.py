"""Trackers: everything that turns recordings of an installation into estimates.

A recording holds what the sensors of an installation measured. A tracker turns it into estimates. A recursive tracker
is a motion, some sensors, a filter and a start. Estimates can become the readings of the next tracker. `README.md`
shows how the parts fit.
"""
