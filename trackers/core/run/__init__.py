"""Trackers and the one scan that runs them, checks before it, and the bound on what it can reach."""
