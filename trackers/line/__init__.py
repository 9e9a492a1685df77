"""System B: a tag on an assembly line whose path is known, by particles and by a grid."""
