"""Whether a site has changed: a sequential test on readings without truth, and what has changed."""
