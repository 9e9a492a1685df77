"""The engine: states, motions, sensors, recordings, filters, the scan, smoothers, tunables."""
