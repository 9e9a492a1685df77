"""Estimates against truth: association, scores, metrics, and what they say."""
