"""Real recordings, recovery of simulated noise levels, tuning against the sweep, and the demo."""
