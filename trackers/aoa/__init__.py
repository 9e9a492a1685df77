"""System A: antenna arrays at 24 GHz; beamformers, beam tracker, bearings-only fusion, position from phases."""
