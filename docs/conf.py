"""How Sphinx makes the site of `make docs`: its sources are the repository's own pages, found from its root."""

from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
project, author, html_title = "mmgsd", "the authors of mmgsd", "mmgsd"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "README"
include_patterns = ["*.md", *(f"{folder}/*.md" for folder in ("docs", "data/results", "data/weights"))]
html_theme, html_extra_path, html_copy_source = "furo", ["index.html"], False

myst_heading_anchors = 6  # GitHub's
default_role = "py:obj"  # `Matcher.match` in a docstring is a link where that is on the reference
autodoc_member_order, autodoc_typehints, autodoc_default_options = "bysource", "none", {"members": True}
autodoc_mock_imports = ["bpy"]
nitpicky = False

CONTENTS = """

```{toctree}
:hidden:
:caption: %s

%s
```
"""
PAGES = {
    "Use": ["docs/your-photographs", "docs/folding", "docs/page", "docs/onnx", "docs/api", "docs/reference"],
    "Make it yours": ["docs/extending", "docs/data-card", "docs/clusters-and-gpus", "CONTRIBUTING", "CHANGELOG"],
    "Results": ["data/results/README", "data/results/shipped", "docs/claims", "data/results/LOG"],
    "Weights": sorted(f"data/weights/{path.stem}" for path in (ROOT / "data" / "weights").glob("*.md")),
}


def setup(app: Any) -> None:
    """Give the first page, which GitHub shows as well, its table of contents."""
    app.connect("source-read", add_contents)


def add_contents(app: Any, name: str, source: list[str]) -> None:
    """Sphinx's hook: a page's source, as it is read."""
    if name == root_doc:
        source[0] += "".join(CONTENTS % (caption, "\n".join(pages)) for caption, pages in PAGES.items())
