"""Huang et al. 2018: MH-K for a drifting UWB tag, its printed figures."""
