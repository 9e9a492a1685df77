"""Oracles for gradients, and the table of what every estimator makes of them."""
