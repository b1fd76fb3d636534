"""Figures as users get them: shown in notebooks, written as pages or as pictures."""

import io
from pathlib import Path
from typing import Any

from jaxid.io import FilePath

from .figure_elements import Drawing
from .page import render_page


class Figure(Drawing):
    """Panels with a title and one legend, or a robot in space."""

    def matplotlib(self) -> Any:
        """Return a `matplotlib.figure.Figure`, to be changed for a paper."""
        # matplotlib is slow to load, and pages do not need it.
        from .matplotlib_figures import draw

        return draw(self)

    def save(self, path: FilePath) -> None:
        """Write a page to explore (`.html`), or PNG, PDF or SVG; the file has no date.

        Args:
            path: Path of the file, whose suffix tells the format.
        """
        path = Path(path)
        if path.suffix == ".html":
            page = render_page(self.title, [("Figure", [self])])
            path.write_text(page, encoding="utf-8")
        else:
            self._write_picture(path, path.suffix[1:])

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self._write_picture(file, "png")
        return file.getvalue()

    def _write_picture(self, file: Any, suffix: str) -> None:
        """Write PNG, PDF or SVG."""
        from .matplotlib_figures import save

        save(self, file, suffix)
