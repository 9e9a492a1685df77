"""The report of a tuning run: one HTML file that shows what was found, how sure it is, and whether to trust it."""
