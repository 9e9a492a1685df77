"""The outside world: command line, recording folders, figures, benchmarks, one file per printed table."""
