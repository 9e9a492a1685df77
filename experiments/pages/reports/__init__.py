"""Reports as HTML pages and as text on a terminal."""
