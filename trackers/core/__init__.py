"""The engine: states, motions, sensors, recordings, the filter, the one scan, tunables, metrics."""
