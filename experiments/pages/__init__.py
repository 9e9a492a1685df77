"""What is looked at: figures, reports, pages with playback, maps of a plan."""
