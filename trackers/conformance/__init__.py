"""Checks that a user's own tracker, motion, sensor, kind of measurement or importer keeps its contract."""
