"""Layouts by gradient: positions of anchors, stations or antennas with the least Cramér–Rao bound over a volume."""
