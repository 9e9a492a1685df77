"""Studies without a printed result: decisions at fastening points, and positions of anchors and antennas."""
