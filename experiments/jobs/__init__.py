"""Independent parts of long work: executors, the environment of workers, trackers and data that travel."""
