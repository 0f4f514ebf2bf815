"""What MkDocs does beside its own for labapp's site (mkdocs.yml, `hooks`).

Pages are added that stand elsewhere or are generated: the glossary, the changes, the decisions and
the commands. Links to files outside of ``docs`` lead to these pages.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import typer.cli
import typer.main

from labapp import cli

ROOT = Path(__file__).resolve().parent.parent

ELSEWHERE = {"CONTEXT.md": "glossary.md", "CHANGELOG.md": "changelog.md", "README.md": "index.md"}
"""Files beside ``docs`` that texts link to, and the page of the site that has their text."""


def commands_page() -> str:
    """Every command of labapp with its arguments and options, as Markdown."""
    command = typer.main.get_command(cli.app)
    context = command.make_context("labapp", ["--help"], resilient_parsing=True)
    text = typer.cli.get_docs_for_click(obj=command, ctx=context, name="labapp")
    return text.replace("# `labapp`", "# Commands", 1)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that do not stand in ``docs``."""
    from mkdocs.structure.files import File

    pages = {
        page: (ROOT / name).read_text("utf-8").replace("](docs/", "](")
        for name, page in ELSEWHERE.items()
        if page != "index.md"
    }
    pages["reference/commands.md"] = commands_page()
    for page, text in pages.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links out of ``docs`` to the pages that have the text."""
    depth = page.file.src_uri.count("/")
    for name, target in ELSEWHERE.items():
        markdown = re.sub(
            rf"\]\((?:\.\./)+{re.escape(name)}(#[^)]*)?\)",
            lambda found, target=target: f"]({'../' * depth}{target}{found[1] or ''})",
            markdown,
        )
    return markdown
