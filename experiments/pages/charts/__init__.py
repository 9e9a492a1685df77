"""All plots: tracks, filters, objectives, studies; one style."""

import matplotlib.artist

# Matplotlib writes the list of properties into the help of every class of artists as it is imported: a tenth of a
# second, for a help that no command shows.
matplotlib.artist.kwdoc = lambda artist: ""
