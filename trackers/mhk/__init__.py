"""System D: median, hidden Markov model over accelerations and Kalman filter for drifting fixes (Huang et al. 2018)."""
