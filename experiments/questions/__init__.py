"""Studies of questions that no paper prints a result for: fastening points, and where stations should stand."""
