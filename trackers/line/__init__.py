"""System B: a tag on an assembly line with a known path; particle filter and grid filter (thesis)."""
