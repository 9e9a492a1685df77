"""All plots: tracks, filters, objectives, studies; one style."""
