"""Hooks of MkDocs: generated pages, figures from result files, and formulas as MathML.

- The Python reference has one page per room of the package; a page lists the public names of the room's `__init__.pyi`.
- The tutorials are the notebooks as they were run and committed.
- Every page is a Jinja template; `figures.py` has the functions that pages call. A missing figure stops the build.
- Formulas between dollar signs become MathML here, so that no script is loaded.
"""

from __future__ import annotations

import ast
import html
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
import yaml
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

#: Order of the rooms in the Python reference; rooms that are not listed follow in alphabetical order.
FIRST_ROOMS = ["settings", "pipeline", "recordings", "datasets", "trajectories", "evaluation"]
#: Parts of the package without a public Python interface.
HIDDEN = {"__main__", "_typing", "cli", "demo"}
#: Pictures that pages show, by folder below the repository's root.
PICTURES = ("experiments/pictures", "experiments/table5/results")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the generated pages into the navigation."""
    api = [{"psotrack": "reference/api/psotrack.md"}]
    api += [{name: f"reference/api/{name}.md"} for name in rooms()]
    config.nav = _replaced(config.nav, {"API": api, "HOW_TO": how_to_pages()})
    return config


def how_to_pages() -> list[Any]:
    """Navigation of the how-to pages: the groups of `how_to.yml`."""
    groups = yaml.safe_load((HERE / "how_to.yml").read_text(encoding="utf-8"))
    return [
        "how-to/index.md",
        *({name: [f"how-to/{page}.md" for page in pages]} for name, pages in groups.items()),
    ]


def rooms() -> list[str]:
    """Names of the rooms and modules of the package that have a page in the Python reference."""
    found = {path.stem for path in PACKAGE.glob("*.py")} | {
        path.parent.name for path in PACKAGE.glob("*/__init__.py")
    }
    names = sorted(found - HIDDEN - {"__init__"})
    return [name for name in FIRST_ROOMS if name in names] + [
        name for name in names if name not in FIRST_ROOMS
    ]


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
    folder = PACKAGE if name == "psotrack" else PACKAGE / name
    dotted = "psotrack" if name == "psotrack" else f"psotrack.{name}"
    stub, init = folder / "__init__.pyi", folder / "__init__.py"
    if not stub.exists():
        modules = sorted(folder.glob("[a-z]*.py"), key=lambda path: path.name) if folder.is_dir() else []
        public = [dotted, *(f"{dotted}.{path.stem}" for path in modules)]
        if name == "psotrack":
            public = []
        blocks = [f"::: {one}\n    options:\n      show_root_full_path: true" for one in public]
        text = [] if blocks else [ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) or ""]
        return "\n\n".join([f"# {dotted}", *text, *blocks])
    text = _with_lists(ast.get_docstring(ast.parse(init.read_text(encoding="utf-8"))) or "")
    blocks = [
        f"::: {dotted}.{path}"
        if _is_documentable(folder, path)
        else f"`{path.rpartition('.')[2]}`: a constant."
        for path in _stub_names(stub)
    ]
    return "\n\n".join([f"# {dotted}", text, *blocks])


def _with_lists(text: str) -> str:
    """A docstring whose titles with an indented line below, as `help` shows them well, become items of a list."""
    return re.sub(
        r"^(\S.*)\n((?: {4}\S.*\n?)+)",
        lambda match: f"- **{match[1]}**: {' '.join(match[2].split())}\n",
        text,
        flags=re.MULTILINE,
    )


def _stub_names(stub: Path) -> list[str]:
    """Paths of the names that a stub imports, relative to the stub's package."""
    tree = ast.parse(stub.read_text(encoding="utf-8"))
    return [
        f"{node.module}.{alias.name}" if node.module else alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.level == 1
        for alias in node.names
    ]


def _is_documentable(folder: Path, path: str) -> bool:
    """Whether the reference can show a name; it cannot show constants that one line assigns together."""
    module, _, name = path.rpartition(".")
    source = folder.joinpath(*module.split(".")).with_suffix(".py")
    if not source.exists():
        return True
    targets = [
        target
        for node in ast.parse(source.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign)
        for target in node.targets
    ]
    together = [one for target in targets if isinstance(target, ast.Tuple) for one in target.elts]
    return not any(isinstance(one, ast.Name) and one.id == name for one in together)


def notebook(path: Path) -> dict[str, str | bytes]:
    """A notebook as Markdown, and its pictures, by file name."""
    read = nbformat.read(path, as_version=4)
    body, resources = MarkdownExporter().from_notebook_node(
        read, resources={"output_files_dir": f"{path.stem}_files", "unique_key": path.stem}
    )
    # Links between notebooks lead to the pages.
    body = re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", body)
    body = re.sub(r"<style scoped>.*?</style>\n?", "", body, flags=re.DOTALL)
    # Tables of pandas look like the other tables of the pages.
    body = body.replace('<table border="1" class="dataframe">', "<table>")
    files: dict[str, str | bytes] = {f"{path.stem}.md": f"{body}\n"}
    return files | resources["outputs"]


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
    content = re.sub(
        r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>',
        lambda match: convert(html.unescape(match[1]).strip(), display="block"),
        content,
        flags=re.DOTALL,
    )
    return re.sub(
        r'<span class="arithmatex">\\\((.*?)\\\)</span>',
        lambda match: convert(html.unescape(match[1])),
        content,
        flags=re.DOTALL,
    )


def _replaced(item: Any, values: dict[str, Any]) -> Any:
    """A navigation tree with its placeholders replaced."""
    if isinstance(item, list):
        return [_replaced(one, values) for one in item]
    if isinstance(item, dict):
        return {key: _replaced(value, values) for key, value in item.items()}
    return values.get(item, item)
