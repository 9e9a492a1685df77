"""System A: antenna arrays, beamformers, the beam tracker, bearings-only fusion, phases straight to position."""
