"""Build the site into build/site: guides, notebooks, and the API from its docstrings.

    pip install ".[docs]" && python docs/build.py

`build/site/index.html` opens without a server and without network. The pages keep the
places that their sources have in the repository, so that links lead to the same pages
here and there. The script fails if a link is broken, if a page is missing, or if a
public name has no page.
"""

import importlib
import inspect
import logging
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import latex2mathml.converter
import lxml.html
import nbformat
from mkdocs.commands.build import build
from mkdocs.config import load_config
from nbconvert import MarkdownExporter

import jaxid

ROOT = Path(__file__).resolve().parent.parent
PAGES, SITE = ROOT / "build" / "pages", ROOT / "build" / "site"
SOURCES = (
    "*.md",
    "docs/*.md",
    "docs/*.png",
    "docs/*.css",
    "docs/*.js",
    "benchmarks/*.md",
    "benchmarks/*.png",
    "benchmarks/*/*.md",
    "LICENSE",
)
"""Files that the site takes as they are."""


class Section(NamedTuple):
    """Page of the API.

    Attributes:
        title: Title of the page.
        path: Place among the pages.
        names: Public names on it, and where each is found.
        summary: First paragraph.
    """

    title: str
    path: str
    names: dict[str, str]
    summary: str


def copy_sources() -> None:
    """Copy guides and pictures to the places that they have in the repository."""
    for pattern in SOURCES:
        for source in ROOT.glob(pattern):
            target = PAGES / source.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)


def convert_notebooks() -> list[str]:
    """Convert the notebooks, with their outputs; return the places of the pages."""
    exporter, places = MarkdownExporter(), []
    (PAGES / "notebooks").mkdir()
    for source in sorted(ROOT.glob("notebooks/*.ipynb")):
        notebook = nbformat.read(source, nbformat.NO_CONVERT)
        notebook.metadata["language_info"] = {"name": "python"}  # colours of the code
        text, resources = exporter.from_notebook_node(notebook)
        for name, picture in resources["outputs"].items():
            unique = f"{source.stem}_{name}"
            (PAGES / "notebooks" / unique).write_bytes(picture)
            text = text.replace(f"({name})", f"({unique})")
        places.append(f"notebooks/{source.stem}.md")
        (PAGES / places[-1]).write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "notebooks" / "arm.urdf", PAGES / "notebooks")
    return places


def correct_links() -> None:
    """Let links to notebooks lead to their pages."""
    for page in PAGES.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        page.write_text(text.replace(".ipynb)", ".md)"), encoding="utf-8")


def public_names(namespace: ModuleType) -> dict[str, object]:
    """Return the public names of a namespace that are no modules."""
    members = vars(namespace).items()
    return {
        name: member
        for name, member in members
        if not name.startswith("_") and not inspect.ismodule(member)
    }


def rooms() -> list[str]:
    """Return the folders of the package, in the order of the pipeline."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = settings["tool"]["importlinter"]["contracts"][0]
    return list(reversed(contract["layers"]))


def sections() -> list[Section]:
    """Return the pages of the API: flat names of each folder, then its namespaces."""
    members = {name: getattr(jaxid, name) for name in dir(jaxid)}
    pages = []
    for room in rooms():
        folder = f"jaxid.{room}"
        flat, namespaces = {}, []
        for name, member in members.items():
            is_namespace = inspect.ismodule(member)
            home = member.__name__ if is_namespace else member.__module__
            if not f"{home}.".startswith(f"{folder}."):
                continue
            if is_namespace:
                title, path = f"jid.{name}", f"api/jid.{name}.md"
                names = {key: f"{home}.{key}" for key in public_names(member)}
                summary = inspect.getdoc(member) or ""
                namespaces.append(Section(title, path, names, summary))
            else:
                flat[name] = f"jaxid.api.{name}"
        if flat:
            title = room.replace("_", " ").capitalize()
            summary = inspect.getdoc(importlib.import_module(folder)) or ""
            pages.append(Section(title, f"api/{room}.md", flat, summary))
        pages += namespaces
    return pages


def write_api() -> list[str]:
    """Write the pages of the API; return their places."""
    overview = ["# The API", "", "`import jaxid as jid`", ""]
    for page in sections():
        prefix = f"{page.title}." if page.title.startswith("jid.") else "jid."
        lines = [f"# {page.title}", "", page.summary, ""]
        links = []
        for name, target in page.names.items():
            heading = f"{prefix}{name}"
            links.append(f"[`{name}`]({Path(page.path).name}#{target})")
            lines += [f"::: {target}", "    options:", f'      heading: "{heading}"']
            lines += [f'      toc_label: "{heading}"', ""]
        (PAGES / page.path).parent.mkdir(exist_ok=True)
        (PAGES / page.path).write_text("\n".join(lines), encoding="utf-8")
        overview += [f"## {page.title}", "", " · ".join(links), ""]
    (PAGES / "api" / "index.md").write_text("\n".join(overview), encoding="utf-8")
    return ["api/index.md", *(page.path for page in sections())]


def in_mathml(output: str, **_: object) -> str:
    """Replace the formulas of a page by MathML, which needs no script."""
    page = lxml.html.fromstring(output)
    for formula in page.find_class("arithmatex"):
        latex = formula.text_content().strip()
        display = "block" if formula.tag == "div" else "inline"
        mathml = latex2mathml.converter.convert(latex[2:-2], display=display)
        formula.text = None
        formula.append(lxml.html.fromstring(mathml))
    return lxml.html.tostring(page, encoding="unicode", doctype="<!doctype html>")


def built_pages() -> list[Path]:
    """Return the pages of the site, but for the one of addresses that do not exist."""
    return [path for path in SITE.rglob("*.html") if path.name != "404.html"]


def broken_links() -> Iterator[str]:
    """Yield links of the built pages that lead nowhere, and code from the net."""
    pages = {path: lxml.html.parse(path).getroot() for path in built_pages()}
    anchors = {path: set(page.xpath("//@id | //@name")) for path, page in pages.items()}
    for path, page in pages.items():
        for element, attribute, link, _ in page.iterlinks():
            if link.startswith(("http:", "https:", "mailto:", "data:")):
                if element.tag in ("script", "img") or attribute == "src":
                    yield f"{path.relative_to(SITE)}: {link} is loaded from the net"
                continue
            place, _, anchor = link.partition("#")
            target = (
                (path.parent / place.partition("?")[0]).resolve() if place else path
            )
            if target.is_dir():
                target /= "index.html"
            if not target.exists():
                yield f"{path.relative_to(SITE)}: {link}"
            elif anchor and target in anchors and anchor not in anchors[target]:
                yield f"{path.relative_to(SITE)}: {link} (no such place on the page)"


def names_without_a_page() -> Iterator[str]:
    """Yield the public names that no page explains."""
    for section in sections():
        page = lxml.html.parse(SITE / Path(section.path).with_suffix(".html"))
        headings = set(page.xpath("//h2/@id"))
        yield from sorted(set(section.names.values()) - headings)


def main() -> None:
    """Gather the pages, build the site and check it."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    # Units behind shapes, as in "[samples, joints] [rad]", look like references.
    references = logging.getLogger("mkdocs.plugins.mkdocs_autorefs._internal.plugin")
    references.setLevel(logging.ERROR)
    shutil.rmtree(PAGES, ignore_errors=True)
    PAGES.mkdir(parents=True)
    copy_sources()
    notebooks = convert_notebooks()
    api = write_api()
    correct_links()
    config = load_config(str(ROOT / "docs" / "mkdocs.yml"))
    for entry in config.nav:
        if isinstance(entry, dict) and "Notebooks" in entry:
            entry["Notebooks"] = notebooks
        if isinstance(entry, dict) and "API" in entry:
            entry["API"] = api
    config.plugins.on_startup(command="build", dirty=False)
    config.plugins.events["post_page"].append(in_mathml)
    build(config)
    sources = len(list(PAGES.rglob("*.md")))
    pages = len(built_pages())
    faults = [*broken_links(), *(f"no page: {x}" for x in names_without_a_page())]
    if pages != sources:
        faults.append(f"{sources} sources, but {pages} pages")
    print(*faults, sep="\n")
    if faults:
        raise SystemExit(f"{len(faults)} faults")
    names = sum(len(section.names) for section in sections())
    print(f"{pages} pages, {names} public names: {SITE / 'index.html'}")


if __name__ == "__main__":
    main()
