"""Benchmarks: one table of cases, listed by `python -m trackwright.experiments.lab.bench`, one timer and one writer."""
