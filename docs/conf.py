"""Settings of the manual: `sphinx-build -W docs docs/_build/html` builds it and executes the tutorials."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "extensions"))

import surrogate  # noqa: E402


def copied(pattern: str, folder: str) -> None:
    """Lay the files that a pattern finds in the repository into a folder of the manual, which is all Sphinx reads."""
    into = HERE / folder
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir()
    for path in sorted(HERE.parent.glob(pattern)):
        shutil.copy2(path, into)


copied("notebooks/*.ipynb", "tutorials")
copied("surrogate/pretrained/*.md", "cards")

project = "surromd"
author = "surromd authors"
project_copyright = author
version = release = surrogate.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "command_reference",
    "kernel_sockets",
    "result_tables",
    "tables_of_code",
]
source_suffix = {".md": "myst-nb", ".ipynb": "myst-nb"}
exclude_patterns = ["_build", "studies", "figures", "extensions"]
myst_enable_extensions = ["deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 3

# Outputs are stripped from the notebooks in git, so that every figure here comes from this version's code.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
# Kernels of the tutorials: small arrays, and two cores that may be busy.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Docstrings name arguments and values in single backticks.
default_role = "code"
# Typographic dashes would make another thing of --steps.
smartquotes = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"

nitpicky = True
html_theme = "furo"
html_title = "surromd"
html_static_path = ["static"]
html_css_files = ["manual.css"]
html_copy_source = False
