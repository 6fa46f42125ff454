"""Hooks of MkDocs: generated pages, figures from result files, and formulas as MathML.

- The Python reference has one page per room of the package, with the names in the room's `__all__`.
- The tutorials are the notebooks as they were run and committed.
- Every page is a Jinja template; `figures.py` has the functions that pages call. A missing figure stops the build.
- Formulas between dollar signs become MathML here, so that no script is loaded.
"""

from __future__ import annotations

import html
import inspect
import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
from jinja2 import TemplateError
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PACKAGE = ROOT / "psotrack"
sys.path[:0] = [str(HERE), str(ROOT)]

import figures  # noqa: E402

#: Parts of the package without a public Python interface.
HIDDEN = {"__init__", "__main__", "cli"}
#: Pictures that pages show, by folder below the repository's root.
PICTURES = ("experiments/pictures",)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages of the Python reference into the navigation."""
    pages = [{name: f"reference/api/{name}.md"} for name in ["psotrack", *rooms()]]
    for section in config.nav:
        section.get("Reference", []).append({"Python": pages})
    return config


def rooms() -> list[str]:
    """Names of the rooms and modules of the package that have a page in the Python reference."""
    found = {path.stem for path in PACKAGE.glob("*.py")}
    folders = (*PACKAGE.glob("*/__init__.py"), *PACKAGE.glob("*/*/__init__.pyi"))
    return sorted(found.union(".".join(each.relative_to(PACKAGE).parts[:-1]) for each in folders) - HIDDEN)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the Python reference, the notebooks and the pictures."""
    for name in ["psotrack", *rooms()]:
        files.append(File.generated(config, f"reference/api/{name}.md", content=api_page(name)))
    for path in sorted((ROOT / "notebooks").glob("[a-z]*.ipynb")):
        for name, content in notebook(path).items():
            files.append(File.generated(config, f"tutorials/{name}", content=content))
    for folder in PICTURES:
        for path in sorted((ROOT / folder).glob("*.png")):
            files.append(File.generated(config, f"pictures/{path.name}", abs_src_path=str(path)))
    return files


def api_page(name: str) -> str:
    """The page of a room: its docstring, and its public names."""
    room = import_module("psotrack" if name == "psotrack" else f"psotrack.{name}")
    # Titles with an indented line below, as `help` shows them well, become items of a list.
    text = re.sub(
        r"^(\S.*)\n((?: {4}\S.*\n?)+)",
        lambda match: f"- **{match[1]}**: {' '.join(match[2].split())}\n",
        inspect.getdoc(room) or "",
        flags=re.MULTILINE,
    )
    return "\n\n".join([f"# {room.__name__}", text, *(_entry(room, one) for one in public_names(room))])


def public_names(room: ModuleType) -> list[str]:
    """Names that a room exports, or those that a module defines; of the package itself, its lazy names."""
    if room.__name__ == "psotrack":
        return dir(room)
    own = [name for name, value in vars(room).items() if getattr(value, "__module__", "") == room.__name__]
    return list(getattr(room, "__all__", [name for name in own if not name.startswith("_")]))


def _entry(room: ModuleType, name: str) -> str:
    """A public name: its documentation, or from the package's own page a link to that on the page of a room."""
    value = getattr(room, name)
    if not (getattr(value, "__module__", "").startswith("psotrack") and hasattr(value, "__qualname__")):
        return f"`{name}`: a {'module' if inspect.ismodule(value) else 'constant or type'}."
    path = f"{value.__module__}.{value.__qualname__}"
    if room.__name__ != "psotrack":
        return f"::: {path}"
    return f"- [`{name}`][{path}]: {(inspect.getdoc(value) or '').partition(chr(10))[0]}"


def notebook(path: Path) -> dict[str, str | bytes]:
    """A notebook as Markdown, and its pictures, by file name."""
    body, resources = MarkdownExporter().from_notebook_node(
        nbformat.read(path, as_version=4),
        resources={"output_files_dir": f"{path.stem}_files", "unique_key": path.stem},
    )
    # Links between notebooks lead to the pages; tables of pandas look like the other tables of the pages.
    body = re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", body)
    body = re.sub(r"<style scoped>.*?</style>\n?", "", body, flags=re.DOTALL)
    body = body.replace('<table border="1" class="dataframe">', "<table>")
    return {f"{path.stem}.md": f"{body}\n"} | resources["outputs"]


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in the figures of a page that a person has written."""
    if page.file.generated_by:
        return markdown
    try:
        return figures.render(markdown)
    except (TemplateError, figures.MissingFigureError) as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error


def on_page_content(content: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Replace formulas by MathML."""

    def formula(match: re.Match[str]) -> Any:
        block = match[1] == "div"
        return convert(html.unescape(match[2]).strip(), display="block" if block else "inline")

    pattern = r'<(div|span) class="arithmatex">\s*\\[\[(](.*?)\\[\])]\s*</\1>'
    return re.sub(pattern, formula, content, flags=re.DOTALL)
