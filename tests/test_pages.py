"""Pages of the documentation: links, anchors, alternative texts, and a description of every public name.

The site itself is built by `make docs`, whose tools the tests do not need.
"""

import importlib.util
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "notebooks" / "README.md",
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
]
# Pages whose lines are code or data of others.
_CODE = re.compile(r"^(```|~~~).*?^\1", re.S | re.M)


def _tool():
    """scripts/docs_pages.py as a module; scripts is no package."""
    spec = importlib.util.spec_from_file_location("docs_pages", ROOT / "scripts" / "docs_pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["docs_pages"] = module
    spec.loader.exec_module(module)
    return module


def text_of(path: Path) -> str:
    """The Markdown of a page, without blocks of code."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n\n".join("".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "markdown")
    return _CODE.sub("", text)


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a page, as code hosts and MyST make them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ +(.*)$", text_of(path), re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        found.add(re.sub(r"[^\w\- ]", "", plain).strip().replace(" ", "-"))
    return found


def links(path: Path) -> list[tuple[str, str]]:
    """(text, target) of links and pictures of a page, without those to the web."""
    text = re.sub(r"`[^`\n]*`", "", text_of(path))
    found = re.findall(r"(!?\[[^\]]*\])\(([^)\s]+)\)", text)
    return [(said, target) for said, target in found if "://" not in target]


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page):
    for said, target in links(page):
        name, _, anchor = target.partition("#")
        there = (page.parent / name).resolve() if name else page
        if page.parent.name == "site":
            there = (ROOT / name).resolve()  # copied to the top of the site
        assert there.exists(), f"{said}({target})"
        assert not anchor or anchor in anchors(there), f"{said}({target}): there are {sorted(anchors(there))}"


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_pictures_have_alternative_texts(page):
    for said, target in links(page):
        assert not said.startswith("!") or len(said) > 12, target


@pytest.mark.parametrize("page", [page for page in PAGES if page.suffix == ".md"], ids=named)
def test_prose_is_wrapped(page):
    """But for rows of tables, and what a benchmark writes (between its marks)."""
    text = re.sub(r"<!-- (\w+): begin -->.*?<!-- \1: end -->", "", page.read_text(encoding="utf-8"), flags=re.S)
    for line in text.splitlines():
        whole = line.lstrip().startswith(("|", "![")) or "://" in line
        assert len(line) <= 120 or whole, line


def test_the_site_lists_every_page():
    index = (ROOT / "docs" / "site" / "index.md").read_text(encoding="utf-8")
    for page in PAGES:
        name = page.relative_to(ROOT).with_suffix("").as_posix()
        if page.parent.name not in ("site", "decisions"):
            assert re.search(rf"^{re.escape(name)}$", index, re.M), f"docs/site/index.md does not list {name}"


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120


def test_every_public_name_is_described():
    tool = _tool()
    missing = [name for module in tool.all_modules() for name in tool.undocumented(module)]
    assert not missing


def test_reference_has_an_entry_for_every_name():
    tool = _tool()
    module = importlib.import_module("scsr_opt.solvers")
    page = tool.reference_page(module)
    for name in module.__all__:
        assert f"## `{name}`" in page
    assert "FISTA(\n    iterations: int = 200" in page
    assert "scsr_opt/solvers/proximal_gradient.py" in page


def test_command_line_page_has_every_command():
    page = _tool().command_line_page()
    for name in (
        "info",
        "simulate",
        "play",
        "solve",
        "batch",
        "sequence",
        "export",
        "baseline",
        "compare",
        "train",
        "warm",
        "cache",
        "demo",
    ):
        assert f"## scsr {name}\n\n```text\nUsage: scsr {name} " in page
    assert "--strength" in page


def commands(page: str) -> list[str]:
    """Lines of the shell in a page's examples, but for those that are marked as not run."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.S)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    for line in lines:
        runs = page in RUN and line.startswith("scsr ")
        assert runs or re.search(r"# not run: \w+", line), f"{page}: say why it is not run: {line}"
    return [line[line.index("scsr ") :] for line in lines if re.match(r"(.+ \| )?scsr ", line)]


# Pages whose commands `tests/test_docs.py` runs.
RUN = ("README.md", "docs/howto.md", "docs/sequences.md")


@pytest.mark.parametrize("page", [*RUN, "docs/real-recordings.md", "docs/learned.md"])
def test_commands_are_understood(page):
    """Every option of every command is known and of the right type; `tests/test_docs.py` runs those of README and
    how-to."""
    from scsr_opt.cli.app import _app

    given = commands(page)
    assert given
    for line in given:
        tokens = shlex.split(line, comments=True)[1:]
        _app().parse_args(tokens, exit_on_error=False, print_error=False)


@pytest.mark.slow
def test_site_builds_without_warnings(tmp_path):
    """Needs the environment that `make docs` makes (or DOCS_VENV)."""
    python = ROOT / os.environ.get("DOCS_VENV", "build/docs-venv") / "bin" / "python"
    if not python.exists():
        pytest.skip(f"{python} is not there: make docs makes it")
    _tool().write(tmp_path / "source")
    build = [python, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", tmp_path / "source", tmp_path / "site"]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "reference" / "scsr_opt.solvers.html").exists()
    assert (tmp_path / "site" / "search.html").exists()
