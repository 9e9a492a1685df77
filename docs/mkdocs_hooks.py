"""What `make docs` adds to the Markdown of this folder: the README as first page, the notebook with what it shows, and
API pages from docstrings.

Each group of public names in the stub `__init__.pyi` of a package, begun there by a comment, becomes a page.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "tw": "trackwright",
    **{f"tw.{name}": name for name in ("sim", "tuning")},
    **{f"tw.{name}": f"trackers/{name}" for name in ("aoa", "evaluation", "exchange", "line", "parts", "uwb_imu")},
}
"""The folders of the stubs by the names under which `import trackwright as tw` has them."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=re.sub(r"\]\(docs/", "](", readme)))
    files.append(File.generated(config, "notebook.md", content=_markdown(ROOT / "docs/notebook.ipynb")))
    pages = {f"api/{page}.md": content for name in PACKAGES for page, content in _api_pages(name)}
    for path, content in pages.items():
        files.append(File.generated(config, path, content=content))
    config.nav = [*(config.nav or []), {"API": ["api.md", *sorted(pages)]}]
    return files


def _api_pages(package: str) -> Iterator[tuple[str, str]]:
    """Name and text of a page for each group of public names."""
    text = (ROOT / PACKAGES[package] / "__init__.pyi").read_text(encoding="utf-8")
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
    groups.pop("modules", None)  # those of the other folders
    for title, names in groups.items():
        short = re.sub(r"\W+", "-", title.partition(":")[0].partition(",")[0]).strip("-")
        parts = [f"::: {homes[name]}" for name in names]
        yield f"{package}-{short}", "\n\n".join([f"# {package}: {title}", *parts]) + "\n"


def _markdown(path: Path) -> str:
    """A notebook as Markdown, executed: what a cell shows follows its code."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    parts = []
    for cell in notebook.cells:
        is_code = cell.cell_type == "code"
        parts.append(f"```python\n{cell.source}\n```" if is_code else cell.source)
        parts += [_shown(output) for output in cell.get("outputs", ())]
    return "\n\n".join(parts)


def _shown(output: Mapping[str, Any]) -> str:
    """A table, a picture or text that a cell shows."""
    data = output.get("data", {})
    if "text/html" in data:
        # A blank line would end the HTML, and an indented one begin code.
        return re.sub(r"\n\s*", "\n", f"<div>{data['text/html']}</div>")
    if "image/png" in data:
        return f'<img alt="the chart of the code above" src="data:image/png;base64,{data["image/png"].strip()}">'
    return f"```text\n{output.get('text') or data.get('text/plain', '')}\n```"
