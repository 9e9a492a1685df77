"""Data-quality checks of a recording; `all_checks` runs them."""
