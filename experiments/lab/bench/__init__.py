"""Benchmarks: a table of cases with one timer and one writer; `python -m experiments.lab.bench` lists them."""
