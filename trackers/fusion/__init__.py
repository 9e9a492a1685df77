"""The tracker `fusion`: ranges, range differences, bearings and fixes in one state."""
