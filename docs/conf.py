"""How Sphinx makes the site of `make docs`: its sources are the repository's own pages, found from its root."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
project, author, html_title = "mmgsd", "the authors of mmgsd", "mmgsd"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "data/results/*.md", "data/weights/*.md"]
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
    "Results": ["data/results/README", "docs/claims", "data/results/LOG"],
    "Weights": sorted(f"data/weights/{path.stem}" for path in (ROOT / "data" / "weights").glob("*.md")),
}


def setup(app):
    """Give the first page, which GitHub shows as well, its table of contents."""
    app.connect("source-read", add_contents)


def add_contents(app, name, source):
    """Sphinx's hook: a page's source, as it is read."""
    if name == root_doc:
        source[0] += "".join(CONTENTS % (caption, "\n".join(pages)) for caption, pages in PAGES.items())
