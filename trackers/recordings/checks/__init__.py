"""Data-quality checks of a recording, which `all_checks` runs."""
