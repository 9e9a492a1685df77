"""Right place? Which point of work an estimate names, and how often that is right."""
