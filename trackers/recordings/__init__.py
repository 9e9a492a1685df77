"""Recording folders: read, checked, written and turned into trajectories. Only this package opens recordings."""
