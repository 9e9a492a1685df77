"""What `make docs` adds to the Markdown of this folder: the README as first page, the notebook with what it shows, code
of the examples and pages of the program in the gallery, and API pages from docstrings.

Each group of public names in the stub `__init__.pyi` of a package, begun there by a comment, becomes a page.
"""

from __future__ import annotations

import ast
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import nbformat
from gallery import pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "tw": "trackwright",
    **{f"tw.{name}": name for name in ("sim", "tuning")},
    **{
        f"tw.{name}": f"trackers/{name}"
        for name in ("aoa", "baselines", "evaluation", "exchange", "line", "mhk", "parts", "uwb_imu")
    },
}
"""The folders of the stubs by the names under which `import trackwright as tw` has them."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the generated pages."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=re.sub(r"\]\(docs/", "](", readme)))
    files.append(File.generated(config, "notebook.md", content=_markdown(ROOT / "docs/notebook.ipynb")))
    api = {f"api/{page}.md": content for name in PACKAGES for page, content in _api_pages(name)}
    with tempfile.TemporaryDirectory() as folder:
        shown = {f"pages/{name}.html": content for name, content in pages(Path(folder)).items()}
    for path, content in (api | shown).items():
        files.append(File.generated(config, path, content=content))
    config.nav = [*(config.nav or []), {"API": ["api.md", *sorted(api)]}]
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, **_: Any) -> str:
    """Keeps makers' pages out of the search; the code of an example follows its link, and a page of the program stands
    where its picture does.
    """
    if any(page.file.src_uri in section.get("For makers", ()) for section in config.nav or ()):
        page.meta["search"] = {"exclude": True}
    if page.file.src_uri != "gallery.md":
        return markdown
    frame = '<iframe title="\\1" src="pages/\\1.html" loading="lazy" style="width:100%;height:40rem;border:0"></iframe>'
    framed = re.sub(r"<!-- page: (\w+) -->\n\n!\[.*\n", f"{frame}\n\n[the page alone](pages/\\1.html)\n", markdown)
    return re.sub(r"\[`(.*)`\]\(\.\./\1\)", lambda link: _folded(ROOT / link[1]), framed)


def _folded(path: Path) -> str:
    """The code of a file, which a click unfolds."""
    code = re.sub(r"^", "    ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return f'\n\n??? example "{path.name}"\n\n    ```python\n{code}\n    ```\n'


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
        return re.sub(r"\n\s*", "\n", f'<div style="overflow-x: auto">{data["text/html"]}</div>')
    if "image/png" in data:
        return f'<img alt="the chart of the code above" src="data:image/png;base64,{data["image/png"].strip()}">'
    return f"```text\n{output.get('text') or data.get('text/plain', '')}\n```"
