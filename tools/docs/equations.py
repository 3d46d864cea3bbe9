"""Equations in the pages, $…$ and $$…$$, become MathML when the site is built: browsers show it without a script."""

from __future__ import annotations

import re

from latex2mathml.converter import convert

PARTS = re.compile(r"(^```.*?^```|`[^`\n]+`)|\$\$(.+?)\$\$|\$([^$\n]+)\$", re.MULTILINE | re.DOTALL)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Called by MkDocs for each page; code is left alone."""

    def replaced(found: re.Match) -> str:
        code, display, inline = found.groups()
        if code is not None:
            return code
        text = display or inline
        return " ".join(convert(text.strip(), display="block" if display else "inline").split())

    return PARTS.sub(replaced, markdown)
