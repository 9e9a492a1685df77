"""Rows of recordings, estimates, and measures of their errors."""
