"""Links of the repository's pages: relative ones lead somewhere, absolute ones to sites that are known to exist."""

import json
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
#: Sites of papers, data and libraries; of GitHub, the repositories of others.
SITES = {
    "doi.org", "zenodo.org", "arxiv.org", "www.w3.org", "www.c3d.org", "mcap.dev", "rerun.io", "distributed.dask.org",
    "jobqueue.dask.org", "ternaris.gitlab.io", "keepachangelog.com", "semver.org",
    "github.com/DroneDetectionThesis/Drone-detection-dataset", "github.com/JonathonLuiten/TrackEval",
    "github.com/MichaelGrupp/evo", "github.com/RobertTLange/evosax", "github.com/backyardbiomech/argus_gui",
    "github.com/cheind/py-motmetrics", "github.com/ethz-asl/kalibr", "github.com/perfanalytics/pose2sim",
    "github.com/pyomeca/ezc3d", "github.com/tlhedrick/dltdv", "github.com/zju3dv/EasyMocap",
}  # fmt: skip
URL = re.compile(r"https?://((?:[\w-]+\.)+[a-z]{2,}(?:/[\w./-]*)?)", re.IGNORECASE)
LINK = re.compile(r"\]\(([^()\s]+)\)")
#: Pages of which a program writes the headings; `mkdocs build --strict` follows the links to these.
GENERATED = re.compile(r"\{\{ (?:cli_reference|struct_tables)")


def files(*endings: str) -> list[Path]:
    """Files of the repository with one of these endings."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    found = [ROOT / name for name in listed.stdout.splitlines() if name.endswith(endings)]
    return [path for path in found if path.exists()]


def text_of(path: Path) -> str:
    """The text that people read: of a notebook, the cells that are written in Markdown."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    return "\n".join(
        "".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"
    )


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


def anchors(text: str) -> set[str]:
    """Anchors of the headings of a page, as MkDocs and GitHub make them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def source(page: Path, target: str) -> Path:
    """The file that a relative link means; the pages' pictures and tutorials are made from files beside them."""
    path = (page.parent / target).resolve()
    if not path.is_relative_to(PAGES) or path.exists():
        return path
    folder, name = path.relative_to(PAGES).parts[0], path.name
    if folder == "tutorials":
        return ROOT / "notebooks" / f"{path.stem}.ipynb"
    if folder == "pictures":
        return next((found for found in (ROOT / "experiments").rglob(name)), path)
    if path.parent.name == "api":
        return ROOT / "psotrack" / ("" if path.stem == "psotrack" else path.stem)
    return path


def broken(page: Path) -> list[str]:
    """Relative links of a page that lead nowhere."""
    found = []
    for link in LINK.findall(without_code(text_of(page))):
        target, _, anchor = link.partition("#")
        if re.match(r"\w+:", target):
            continue
        path = source(page, target) if target else page
        if not path.exists():
            found.append(f"{page.relative_to(ROOT)}: {link}")
        elif anchor and path.suffix in (".md", ".ipynb"):
            text = text_of(path)
            if not GENERATED.search(text) and anchor not in anchors(text):
                found.append(f"{page.relative_to(ROOT)}: {link}: no such heading")
    return found


def strange(path: Path) -> list[str]:
    """Addresses in a file that are not of a known site."""
    return [
        f"{path.relative_to(ROOT)}: {address}"
        for address in URL.findall(path.read_text(encoding="utf-8"))
        if not any(f"{address}/".startswith(f"{site}/") for site in SITES)
    ]


def test_every_relative_link_leads_to_a_file_and_a_heading() -> None:
    assert [link for page in files(".md", ".ipynb") for link in broken(page)] == []


def test_every_absolute_link_leads_to_a_known_site() -> None:
    written = [
        path
        for path in files(".md", ".ipynb", ".cff", ".toml", ".yml", ".py", ".pyi", "Makefile")
        if "tests" not in path.parts[len(ROOT.parts) :]
    ]
    assert [address for path in written for address in strange(path)] == []


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("[here](b.md) [there](b.md#part-one) `[code](c.md)`", 0),
        ("[nowhere](c.md)", 1),
        ("[nowhere](b.md#part-two)", 1),
        ("https://doi.org/10.5281/zenodo.14748573", 0),
        ("https://github.com/nobody/psotrack", 1),
        ("https://doi.org.example/x", 1),
    ],
)
def test_a_wrong_link_is_found(
    text: str, faults: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / "b.md").write_text("# Part one\n")
    page = tmp_path / "a.md"
    page.write_text(text)
    assert len(broken(page)) + len(strange(page)) == faults
