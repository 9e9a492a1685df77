"""Files of other programs: trajectories, logs and bags in, estimates out; trajectory errors as evo defines them."""
