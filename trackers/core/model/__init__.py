"""What the trackers are made of: states, motions, sensors, starts, tunable numbers, and the small algebra beneath."""
