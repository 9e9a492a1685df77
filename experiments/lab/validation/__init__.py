"""Accuracy on real recordings, limits of precision, coverage: `python -m trackwright.experiments.lab.validation`."""
