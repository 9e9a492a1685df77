"""The commands of `trackwright`, one file each; their docstrings are the help."""
