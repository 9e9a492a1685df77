"""What the command line knows of each system: its trackers by name, and the lanes they take."""
