"""HTML pages that need no network: the frame of a page, the 3D view in a page, and in a notebook's cell."""

from __future__ import annotations

import base64
import gzip
import html
import json
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from psotrack import __version__
from psotrack.errors import OutputError
from psotrack.support import atomic_write, refuse_to_overwrite

#: Largest size of a page, bytes: what e-mail and chat programs take as an attachment.
MOST_BYTES = 8_000_000
#: Height of a 3D view in a notebook, pixels.
_CELL_HEIGHT_PX = 520


def _asset(name: str) -> str:
    return (files("psotrack.show.reports") / "assets" / name).read_text(encoding="utf-8")


@cache
def _packed_library() -> str:
    """The library of the 3D view, compressed, as base64; the same bytes each time."""
    return base64.b64encode(gzip.compress(_asset("three.bundle.js").encode(), mtime=0)).decode("ascii")


def scene_frame(scene: dict[str, Any]) -> str:
    """A 3D view as an HTML element of its own, for a notebook's cell; see `render`."""
    content = render("scene.html", scene, title="3D view")
    return (
        f'<iframe title="3D view" srcdoc="{html.escape(content)}" '
        f'style="width: 100%; height: {_CELL_HEIGHT_PX}px; border: 0"></iframe>'
    )


def render(template: str, scene: dict[str, Any], **values: Any) -> str:
    """The text of a page.

    Args:
        template: name of a file in `assets`.
        scene: data of the 3D view; see `scene.scene_data`.
        **values: what the template shows; text is escaped.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("psotrack.show.reports", "assets"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # `</script>` and the like in the data cannot end the script.
    data = json.dumps(scene, allow_nan=False).replace("<", "\\u003c").replace("&", "\\u0026")
    started = f"psotrackScene(document.getElementById('scene'), {data});"
    script = f"{_asset('scene.js')}\npsotrackStart({json.dumps(_packed_library())}, () => {{{started}}});"
    return environment.get_template(template).render(
        # The JavaScript and the base64 come from the package, and the data hold no "<".
        scripts=Markup(f"<script>{script}</script>"),
        page_css=Markup(_asset("page.css")),
        scene_css=Markup(_asset("scene.css")),
        page_js=Markup(_asset("page.js")),
        version=__version__,
        **values,
    )


def write_page(path: Path | str, text: str, *, force: bool = False) -> None:
    """Write a page.

    Raises:
        OutputError: the name does not end in .html, the page is larger than `MOST_BYTES`, the file exists and `force`
            is not set, or it cannot be written.
    """
    check_page_path(path, force)
    content = text.encode("utf-8")
    if len(content) > MOST_BYTES:
        raise OutputError(
            path,
            expected=f"a page of at most {MOST_BYTES / 1e6:.0f} MB",
            found=f"{len(content) / 1e6:.1f} MB",
            remedy="show fewer frames, or fewer files of tracks",
        )
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def check_page_path(path: Path | str, force: bool) -> None:
    """Raise `OutputError` unless a page may be written at `path`."""
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise OutputError(path, expected="a file that ends in .html", found=path.name)
    refuse_to_overwrite(path, force)
