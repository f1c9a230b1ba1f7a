"""Pages of the documentation site that are made from the packages: public names, and the command line.

    python scripts/docs_pages.py build/docs-source

copies README, docs, notebooks and the other pages to a folder, laid out as in the repository, and adds what Sphinx
needs (docs/site) and the pages of the reference. Nothing but the packages themselves is needed; `make docs` runs
Sphinx on the folder afterwards.
"""

import ast
import contextlib
import dataclasses
import enum
import importlib
import inspect
import io
import os
import pkgutil
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

from numpy.typing import ArrayLike

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE")
PACKAGES = (
    "scsr_opt", "scsr_opt.camera", "scsr_opt.camera.scenes", "scsr_opt.motion", "scsr_opt.calibration",
    "scsr_opt.operators", "scsr_opt.priors", "scsr_opt.solvers", "scsr_opt.pipeline", "scsr_opt.baselines",
    "scsr_opt.report", "scsr_opt.sequences", "scsr_opt.progress", "scsr_opt.errors", "learned", "learned.zoo",
    "learned.evaluation.compare",
    "learned.evaluation.stage_report", "learned.evaluation.reference_problem", "learned.evaluation.inference",
    "learned.networks.encoder", "learned.networks.gradient", "learned.networks.fusion", "learned.networks.proximal",
    "learned.networks.spikesr", "learned.networks.unrolled_ista", "learned.networks.velocity",
    "learned.networks.compensation", "learned.networks.restoration", "learned.training.configs",
    "learned.training.data", "learned.training.loop", "learned.training.registry", "learned.training.checkpoint",
)  # fmt: skip
"""Modules of the reference, a page each, in the order in which they are listed."""


def public_names(module: ModuleType) -> list[str]:
    """Names of a module for its users: `__all__`, or what it defines itself and does not begin with an underscore."""
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return [name for name in listed if not inspect.ismodule(getattr(module, name))]
    package = module.__name__.rpartition(".")[0] if not hasattr(module, "__path__") else module.__name__
    found = []
    for name, value in vars(module).items():
        home = getattr(value, "__module__", "")
        own = home == module.__name__ or (hasattr(module, "__path__") and home.startswith(package + "."))
        if not name.startswith("_") and own and (inspect.isclass(value) or inspect.isroutine(value)):
            found.append(name)
    return found


def all_modules() -> Iterator[ModuleType]:
    """Every public module of both packages, imported."""
    for top in ("scsr_opt", "learned"):
        package = importlib.import_module(top)
        yield package
        for info in pkgutil.walk_packages(package.__path__, f"{top}."):
            if not any(part.startswith("_") for part in info.name.split(".")):
                yield importlib.import_module(info.name)


def members(cls: type) -> list[tuple[str, Any]]:
    """Public methods and properties that a class defines itself, without those of a dataclass or an enumeration."""
    kinds = (property, classmethod, staticmethod)
    found = []
    for name, value in vars(cls).items():
        cached = type(value).__name__ == "cached_property"
        if not name.startswith("_") and (inspect.isroutine(value) or isinstance(value, kinds) or cached):
            found.append((name, value))
    return found


def docstring(value: Any) -> str:
    """The docstring of a name itself, not of what it inherits from; empty where there is none."""
    if isinstance(value, type):
        text = value.__dict__.get("__doc__") or ""
        made = dataclasses.is_dataclass(value) and text.startswith(f"{value.__name__}(")  # dataclass writes a signature
        return "" if made else inspect.cleandoc(text)
    value = getattr(value, "func", value)  # of a cached property
    value = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    return inspect.cleandoc(getattr(value, "__doc__", None) or "")


def described_fields(cls: type) -> list[tuple[str, str]]:
    """Fields of a class with a string below them, as those of settings are: `name: type = default`, and the string."""
    try:
        body = ast.parse(inspect.cleandoc("\n" + inspect.getsource(cls))).body[0]
    except (OSError, TypeError, SyntaxError):
        return []
    found = []
    statements = body.body if isinstance(body, ast.ClassDef) else []
    for field, below in zip(statements, statements[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr)):
            continue
        if isinstance(below.value, ast.Constant) and isinstance(below.value.value, str):
            found.append((ast.unparse(field), " ".join(below.value.value.split())))
    return found


def undocumented(module: ModuleType) -> list[str]:
    """Dotted names of public classes and functions that a module defines, and of their members, without a docstring.

    A method that overrides one of a base class is described there.
    """
    missing = [] if (module.__doc__ or "").strip() else [module.__name__]
    for name, value in vars(module).items():
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if not (inspect.isclass(value) or inspect.isroutine(value)):
            continue
        if not docstring(value):
            missing.append(f"{module.__name__}.{name}")
        if not inspect.isclass(value):
            continue
        for member, function in members(value):
            inherited = any(member in vars(base) for base in value.__mro__[1:])
            if not docstring(function) and not inherited:
                missing.append(f"{module.__name__}.{name}.{member}")
    return missing


def reference_page(module: ModuleType) -> str:
    """The page of a module in Markdown: its docstring, then every public name with signature, docstring and source."""
    lines = [f"# {module.__name__}", "", _text(inspect.cleandoc(module.__doc__ or "")), ""]
    names = public_names(module)
    lines += ["| name | |", "|---|---|"]
    lines += [f"| [`{name}`](#{_anchor(module, name)}) | {_first(getattr(module, name))} |" for name in names]
    for name in names:
        lines += ["", *_entry(module, name, getattr(module, name))]
    return "\n".join(lines) + "\n"


def command_line_page() -> str:
    """The page of the command line: what `scsr COMMAND --help` says, for every command."""
    from scsr_opt.cli.app import _app, main

    lines = ["# Command line", "", "What `scsr COMMAND --help` says.", ""]
    for name in (name for name in _app() if not name.startswith("-")):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), mock.patch.dict(os.environ, COLUMNS="96"):  # characters a line
            main([name, "--help"])
        lines += [f"## scsr {name}", "", "```text", printed.getvalue().strip(), "```", ""]
    return "\n".join(lines)


def _entry(module: ModuleType, name: str, value: Any) -> list[str]:
    lines = [f"({_anchor(module, name)})=", f"## `{name}`", ""]
    if not (inspect.isclass(value) or inspect.isroutine(value)):
        return [*lines, _text(f"A {type(value).__name__}.")]
    lines += ["```python", _signature(name, value), "```", "", _text(docstring(value) or _first(value)), ""]
    if inspect.isclass(value):
        bases = [base.__name__ for base in value.__mro__[1:] if base.__module__.startswith(("scsr_opt", "learned"))]
        if bases:
            lines += [f"Bases: {', '.join(f'`{base}`' for base in bases)}.", ""]
        lines += [f"- `{field}`: {_text(text)}" for field, text in described_fields(value)]
        if issubclass(value, enum.Enum):
            lines += ["| member | |", "|---|---|"]
            lines += [*(f"| `{one.name}` | {_cell(str(one.value))} |" for one in value), ""]
        for member, function in members(value):
            text = docstring(function)
            if not text:
                continue
            plain = isinstance(function, property) or type(function).__name__ == "cached_property"
            shown = f".{member}" if plain else _signature(f".{member}", function)
            lines += [f"**`{' '.join(shown.split())}`**", "", _text(text), ""]
    return [*lines, f"*Defined in* {_source(value)}."]


def _signature(name: str, value: Any) -> str:
    value = value.__func__ if isinstance(value, classmethod | staticmethod) else value
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return name
    parameters = [one for one in signature.parameters.values() if one.name not in ("self", "cls")]
    shown = [re.sub(r"<function (\w+)[^>]*>", r"\1", _parameter(one)) for one in parameters]
    if any(one.kind is one.KEYWORD_ONLY for one in parameters) and not any(
        one.kind is one.VAR_POSITIONAL for one in parameters
    ):
        shown.insert([one.kind is one.KEYWORD_ONLY for one in parameters].index(True), "*")
    returned = signature.return_annotation
    result = "" if returned is inspect.Signature.empty or inspect.isclass(value) else f" -> {_annotation(returned)}"
    one_line = f"{name}({', '.join(shown)}){result}"
    return one_line if len(one_line) <= 100 else f"{name}(\n    " + ",\n    ".join(shown) + f",\n){result}"


def _parameter(one: inspect.Parameter) -> str:
    stars = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
    text = stars + one.name
    if one.annotation is not one.empty:
        text += f": {_annotation(one.annotation)}"
    if one.default is not one.empty:
        default = "…" if "object at 0x" in repr(one.default) or len(repr(one.default)) > 40 else repr(one.default)
        text += f" = {default}"
    return text


def _annotation(annotation: Any) -> str:
    """An annotation without the modules that its names come from."""
    if isinstance(annotation, str):
        return annotation
    text = inspect.formatannotation(annotation)
    text = text.replace(inspect.formatannotation(ArrayLike), "ArrayLike")
    text = re.sub(r"<class '([^']*)'>", r"\1", text)
    return re.sub(r"\b(?:[A-Za-z_]\w*\.)+([A-Za-z_]\w*)", r"\1", text)


def _source(value: Any) -> str:
    try:
        path = Path(inspect.getsourcefile(value) or "").resolve().relative_to(ROOT)
        return f"`{path}`, line {inspect.getsourcelines(value)[1]}"
    except (OSError, TypeError, ValueError):
        return "a compiled module"


def _first(value: Any) -> str:
    """The first sentence of a docstring, for a cell of a table."""
    text = docstring(value) if inspect.isclass(value) or inspect.isroutine(value) else ""
    paragraph = " ".join(text.split("\n\n")[0].split())
    sentence = re.split(r"(?<!Eq)\.\s+(?=[A-Z`])", paragraph)[0]
    return _cell(sentence.rstrip(":"))


def _cell(text: str) -> str:
    return " ".join(_text(text).split()).replace("|", "\\|")


def _text(text: str) -> str:
    """A docstring as Markdown of a page: what looks like HTML is not, and a list needs an empty line before it."""
    lines: list[str] = []
    for line in text.splitlines():
        item = re.match(r"- ", line)
        if item and lines and lines[-1].strip() and not re.match(r"- |  ", lines[-1]):
            lines.append("")
        # Outside code; indented lines are formulas or code.
        if not line.startswith("    "):
            line = re.sub(r"(`[^`]*`)|<", lambda m: m[1] or "&lt;", line)
            line = re.sub(r"(?<![\w*`])([A-Z∇])\*(?!\*)", r"\1\\*", line)  # an adjoint A*, no emphasis
        lines.append(line)
    return "\n".join(lines)


def _anchor(module: ModuleType, name: str) -> str:
    # Anchors do not tell capitals from small letters, names do: `Windows` and `windows`.
    kind = "class-" if inspect.isclass(getattr(module, name)) else ""
    return f"{kind}{module.__name__}-{name}".replace(".", "-").replace("_", "-").lower()


def write(target: Path) -> None:
    """Writes all that Sphinx reads into the folder `target`, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name in PAGES:
        shutil.copy(ROOT / name, target / name)
    for folder in ("docs", "notebooks"):
        shutil.copytree(ROOT / folder, target / folder, ignore=shutil.ignore_patterns("site", ".ipynb_checkpoints"))
    for path in (ROOT / "docs" / "site").iterdir():
        shutil.copy(path, target / path.name)
    reference = target / "reference"
    reference.mkdir()
    for name in PACKAGES:
        page = reference_page(importlib.import_module(name))
        (reference / f"{name}.md").write_text(page, encoding="utf-8")
    (reference / "command-line.md").write_text(command_line_page(), encoding="utf-8")
    listed = "\n".join(f"../reference/{name}" for name in ("command-line", *PACKAGES))
    with (target / "docs" / "reference.md").open("a", encoding="utf-8") as page:
        page.write(f"\n## Commands and public names\n\n```{{toctree}}\n:maxdepth: 1\n\n{listed}\n```\n")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
