"""Studies by name, one a file: the printed results of the four papers and what else trackwright is asked for."""
