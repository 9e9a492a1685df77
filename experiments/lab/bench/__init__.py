"""Benchmarks, one file each, `python -m experiments.lab.bench.NAME`; without a name that of the beam tracker."""
