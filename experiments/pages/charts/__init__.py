"""All charts: of tracks, filters, objectives and studies; one style."""
