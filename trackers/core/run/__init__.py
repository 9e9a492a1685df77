"""Trackers, the scan that runs them, the checks before a run, smoothers, and the Cramér–Rao bound."""
