"""Compiled programs that are kept between runs; without them everything computes the same."""
