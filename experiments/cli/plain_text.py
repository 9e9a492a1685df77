"""Characters that an encoding lacks, as plain ones: for Windows' code pages, and PYTHONIOENCODING=ascii."""

from __future__ import annotations

import codecs
import unicodedata

ERRORS = "trackwright-plain"
"""The name of the error handler for streams and `str.encode`."""

PLAIN = {
    "─": "-", "━": "-", "│": "|", "–": "-", "—": "-", "−": "-", "×": "x", "·": "*", "±": "+-", "→": "->", "≤": "<=",
    "≥": ">=", "≈": "~", "°": " deg", "√": "sqrt", "‘": "'", "’": "'", "“": '"', "”": '"', "Δ": "Delta", "α": "alpha",
    "β": "beta", "λ": "lambda", "μ": "mu", "µ": "u", "π": "pi", "ρ": "rho", "σ": "sigma", "τ": "tau", "χ": "chi",
    "ω": "omega",
}  # fmt: skip
"""Plain text for characters that have no decomposition into ASCII ones."""


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = "".join(map(_of_one, error.object[error.start : error.end]))
    return text, error.end


def _of_one(character: str) -> str:
    found = PLAIN.get(character) or unicodedata.normalize("NFKD", character)
    return "".join(x for x in found if x.isascii()) or "?"


codecs.register_error(ERRORS, _plain)
