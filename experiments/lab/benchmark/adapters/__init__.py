"""One estimator a file: each imports its library when it is used."""
