"""Build the API pages from the docstrings, into build/api (not kept).

    python docs/build_api.py

The first page has the flat names of `jaxid` in the order of the pipeline; each
namespace has its own page. Needs the extra `docs`. A warning about a docstring is an
error.
"""

import inspect
import re
import warnings
from pathlib import Path

import pdoc
import pdoc.render

import jaxid

TARGET = Path(__file__).resolve().parent.parent / "build" / "api"


def main() -> None:
    """Build all pages."""
    warnings.simplefilter("error")
    public = dir(jaxid)
    names = [
        x.__name__ for name in public if inspect.ismodule(x := getattr(jaxid, name))
    ]
    namespaces = "|".join(re.escape(x) for x in names)
    jaxid.__all__ = [x for x in public if not inspect.ismodule(getattr(jaxid, x))]
    pdoc.render.configure(
        docformat="google", math=True, footer_text="jaxid", show_source=False
    )
    pdoc.pdoc("jaxid", rf"!(?!(jaxid|{namespaces})$)", output_directory=TARGET)
    print(f"{TARGET / 'index.html'}")


if __name__ == "__main__":
    main()
