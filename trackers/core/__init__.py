"""The engine: states, motions, sensors, recordings, filters, the scan, smoothers, tunables, metrics.

Read in this order: state, motion, sensor, recording, start, ekf, tracker, scan; then algebra and linearise (how the EKF
becomes scalar arithmetic), rts and smoother, imm, particle, tunable, checks.
"""
