"""Ours beside other libraries: the same readings and start, each estimator at its own best levels and options."""
