"""The site: `sphinx-build -W -c docs . site` renders the pages as they are; its contents are in toc.yml."""

project = "qnerf"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_external_toc"]
include_patterns = ["*.md", "docs/**", "analysis/notebooks/*.ipynb"]
exclude_patterns = [".venv", "site"]
external_toc_path = "docs/toc.yml"
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_merge_streams = True
suppress_warnings = ["myst.xref_missing"]  # folders; tests/test_documents.py checks links
default_role = "code"
autodoc_typehints = "none"
html_theme = "furo"
html_title = "qnerf"
html_show_copyright = False
html_extra_path = ["index.html"]
