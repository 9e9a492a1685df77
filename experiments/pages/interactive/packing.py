"""Data inside a page: arrays as base64, JSON that no text can leave, and the script of the plotting library."""

from __future__ import annotations

import base64
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np


def packed(values: np.ndarray, kind: str = "f4") -> dict[str, str]:
    """An array (n,) as plotly.js takes typed arrays: its kind, as `f4`, and its bytes in base64."""
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<"))
    return {"dtype": kind, "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def rounded(value: float | None, digits: int = 4) -> float | None:
    """The number with so many significant digits; None for one that is not finite, which JSON does not have."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.{digits}g}")


def script_json(content: Any) -> str:
    """The content as JSON for a `<script type="application/json">`, which a `</script>` in a text does not end."""
    return json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")


def plotting_script() -> str:
    """The source of plotly.js in the installed package `plotly`, which takes half a second to import and is not."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8")
