"""Builds the pages of the interface from the docstrings, into build/api (not kept).

    python docs/build_api.py

What stands on the first page is what `import jaxid` gives, in the order of the pipeline; the robots
and the figures have pages of their own. Needs the extra `docs`. A warning about a docstring is an
error.
"""

import ast
import inspect
import warnings
from pathlib import Path

import pdoc
import pdoc.render

import jaxid

TARGET = Path(__file__).resolve().parent.parent / "build" / "api"
MODULES = ("jaxid", "jaxid.robot.library", "jaxid.report.figures")


def public_names() -> list[str]:
    """Names of `jaxid`, in the order in which they are imported there."""
    tree = ast.parse(inspect.getsource(jaxid))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return [alias.asname or alias.name for node in imports for alias in node.names]


def main() -> None:
    """Builds all pages."""
    warnings.simplefilter("error")
    jaxid.__all__ = [name for name in public_names() if name not in ("plot", "robots")]
    pdoc.render.configure(docformat="google", math=True, footer_text="jaxid", show_source=False)
    inner = "!jaxid\\.(?!robot\\.library$|report\\.figures$).*"
    pdoc.pdoc(*MODULES, inner, output_directory=TARGET)
    print(f"{TARGET / 'index.html'}")


if __name__ == "__main__":
    main()
