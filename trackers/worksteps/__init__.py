"""Fastening points: which one is a tool at, is it unlocked there, and how often is that right."""
