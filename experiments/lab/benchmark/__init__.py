"""`trackwright benchmark`: data sets × estimators × protocol, among these other people's programs, with one scorer."""
