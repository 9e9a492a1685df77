"""Benchmarks, one file each: `python -m experiments.bench` for the beam tracker, `python -m experiments.bench.NAME`."""
