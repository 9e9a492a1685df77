"""Checks of likelihoods and gradients against oracles: `trackwright verify`."""
