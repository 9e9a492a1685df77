"""Simulated worlds as recording folders of many tags."""
