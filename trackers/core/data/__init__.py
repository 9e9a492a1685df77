"""Rows of recordings, estimates, and measures of their errors."""

HOLE_S, HOLE_M = 1.0, 0.02  # limits of interpolated truth, s and m: between rows that exceed both there is none
