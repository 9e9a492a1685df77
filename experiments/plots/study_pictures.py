"""Pictures of studies as SVG files in their folder."""

from __future__ import annotations

import base64
from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from experiments.plots.drawings import HEIGHT, WIDTH, drawn
from trackers.recordings.atomic import atomic_write


def picture(
    folder: Path, name: str, draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT
) -> str:
    """The name of the SVG file that `draw` makes of an empty figure of that size in inches."""
    svg = base64.b64decode(drawn(draw, width, height).partition(",")[2])
    atomic_write(folder / name, lambda temporary: temporary.write_bytes(svg))
    return name
