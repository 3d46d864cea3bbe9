"""Docstrings are plain text with examples: as Markdown, with nothing taken for a link, and examples as code."""

from __future__ import annotations

import re

import griffe


class PlainText(griffe.Extension):
    """Changes the docstring of every object that mkdocstrings reads."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Called by griffe."""
        if obj.docstring is not None:
            obj.docstring.value = "\n\n".join(map(markdown, re.split(r"\n\s*\n", obj.docstring.value)))


def markdown(paragraph: str) -> str:
    """A paragraph of a docstring."""
    if paragraph.lstrip().startswith(">>>"):
        return f"```python\n{paragraph}\n```"
    return re.sub(r"([\[\]*<>])", r"\\\1", paragraph)
