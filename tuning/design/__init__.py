"""Layouts by gradient: where anchors, stations or antennas must stand for the least Cramér–Rao bound over a volume."""
