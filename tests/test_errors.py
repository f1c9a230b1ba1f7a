"""What errors say: one sentence each."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]
# Another sentence begins after a full stop and a space; what abbreviations there are end in none of these.
ANOTHER = re.compile(r"[.!?]\s+\S")


def _text(message: ast.expr) -> str | None:
    """A message as it is written, x for each value that is put in; None if it is not written there."""
    match message:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in parts)
    return None


def _messages(package: str) -> Iterator[tuple[str, str]]:
    """Where each message of an `InputError` stands, and its text."""
    for path in sorted((PROJECT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "InputError" and node.args:
                text = _text(node.args[0])
                if text is not None:
                    yield f"{path.relative_to(PROJECT)}:{node.lineno}", text


@pytest.mark.parametrize(("package", "least"), [("scsr_opt", 150), ("learned", 40)])
def test_an_input_error_is_one_sentence(package, least):
    found = list(_messages(package))
    assert len(found) >= least  # the walk sees them
    wrong = [f"{where}: {text}" for where, text in found if ANOTHER.search(text) or not text.endswith(".")]
    assert not wrong, "\n".join(wrong)
