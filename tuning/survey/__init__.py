"""Positions and delays of anchors from walks without truth, by least squares jointly with the paths of the tags."""
