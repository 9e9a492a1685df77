"""Bayesian filters and smoothers behind one interface."""
