"""System D, MH-K: a sliding median, a hidden Markov model of accelerations, a Kalman filter (Huang et al. 2018)."""
