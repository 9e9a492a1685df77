"""Accuracy of an installation over its floor, before anything is recorded."""
