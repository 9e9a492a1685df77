"""What `make docs` adds to the Markdown of this folder: the README as first page, and API pages from docstrings.

Each group of public names in the stub `__init__.pyi` of a package, begun there by a comment, becomes a page.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
SITE = {
    "Begin": ("index", "ten-minutes", "which-tracker", "covariance-too-small", "import", "plan", "notebook"),
    "Understand": ("concepts", "formats", "inputs", "studies", "cluster", "extending", "command-line"),
    "Figures": ("real-recordings", "results", "benchmarks", "performance", "faults"),
    "Background": ("papers", "decisions"),
}
"""Pages of the menu that exist, by section; others are listed behind them."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=re.sub(r"\]\(docs/", "](", readme)))
    files.append(File.generated(config, "notebook.md", content=_markdown(ROOT / "docs/notebook.ipynb")))
    for package in ("trackers", "sim", "tuning"):
        for page, content in _api_pages(package):
            files.append(File.generated(config, f"api/{page}.md", content=content))
    config.nav = _menu({file.src_uri.removesuffix(".md") for file in files.documentation_pages()})
    return files


def _menu(pages: set[str]) -> list[dict[str, list[str]]]:
    """The pages by section."""
    found = {title: [name for name in names if name in pages] for title, names in SITE.items()}
    api = ["api", *sorted(page for page in pages if page.startswith("api/"))]
    known = {name for names in found.values() for name in names} | {*api}
    found["Understand"] += sorted(pages - known)
    return [{title: [f"{name}.md" for name in names]} for title, names in (found | {"API": api}).items()]


def _api_pages(package: str) -> Iterator[tuple[str, str]]:
    """Name and text of a page for each group of the public names of a package."""
    text = (ROOT / package / "__init__.pyi").read_text(encoding="utf-8")
    homes = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.parse(text).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    title, groups = "names", {}
    for line in text[text.index("__all__") :].splitlines():
        comment, name = re.match(r"\s+# (.*)", line), re.match(r'\s*"(\w+)"', line)
        if comment:
            title = comment[1]
        elif name:
            groups.setdefault(title, []).append(name[1])
    for title, names in groups.items():
        short = re.sub(r"\W+", "-", title.partition(":")[0].partition(",")[0]).strip("-")
        parts = [f"::: {homes[name]}" for name in names]
        yield f"{package}-{short}", "\n\n".join([f"# {package}: {title}", *parts]) + "\n"


def _markdown(path: Path) -> str:
    """A notebook without output as Markdown."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    return "\n\n".join(
        text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for cell, text in zip(cells, texts, strict=True)
    )
