"""List every sentence that the window can show: ``python -m tests.gui.words``."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import labapp.gui
from labapp.session import checklist

FOLDER = Path(labapp.gui.__file__).parent


def sentences() -> Iterator[tuple[str, str]]:
    """Yield (place, text) for all texts of the window but docstrings and names in code."""
    for path in sorted((*FOLDER.rglob("*.py"), Path(checklist.__file__))):
        tree = ast.parse(path.read_text("utf-8"))
        unseen = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if not isinstance(node, ast.Constant) or id(node) in unseen:
                continue
            words = node.value
            if isinstance(words, str) and (" " in words.strip() or words[:1].isupper()):
                yield f"{path.name}:{node.lineno}", " ".join(words.split())


if __name__ == "__main__":
    for place, words in sentences():
        print(f"{place:32} {words}")
