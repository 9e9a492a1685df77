"""The page of `track`: estimates that move over the floor plan, with linked charts, in one HTML file."""
