"""The particle filter: propagate and weigh, resample, its score and transition densities, its random numbers."""
