"""What all reports share: the frame of a page that needs nothing from anywhere else, and its sections."""

from __future__ import annotations

from html import escape

from experiments.reports.stylesheet import STYLESHEET


def document(kind: str, title: str, header: str, body: str, style: str = "") -> str:
    """A page; `kind` of report and `title` are plain text, `header` and `body` HTML, `style` more of the stylesheet."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLESHEET}{style}</style>
</head>
<body>
<main>
<header>
<p class="kind">trackwright · {escape(kind)}</p>
<h1>{escape(title)}</h1>
{header}
</header>
{body}
</main>
</body>
</html>
"""


def section(identity: str, heading: str, lead: str, content: str) -> str:
    """A part of a page; nothing without content. The heading and the sentence under it are plain text."""
    if not content:
        return ""
    under = f'<p class="lead">{escape(lead)}</p>' if lead else ""
    return f'<section id="{identity}">\n<h2>{escape(heading)}</h2>\n{under}\n{content}\n</section>\n'
