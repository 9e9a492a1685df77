"""Recording folders: the only part of the library that opens recordings: rig.toml, tables, truth, checks."""
