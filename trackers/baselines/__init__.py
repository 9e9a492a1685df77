"""Baselines: filters and moving windows on the position fixes of a locating system."""
