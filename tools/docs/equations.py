"""What MkDocs changes in the pages: equations, $…$ and $$…$$, become MathML, which browsers show without a script; the
pictures of jobs/ and its examples as notebooks become part of the site.
"""

import re
import sys
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
import notebooks  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
INLINE = r"((?:[^{0}\n]|\n(?!\s*\n))+)"  # may go on over lines, but not beyond its paragraph
PARTS = re.compile(
    rf"(^```.*?^```|`{INLINE.format('`')}`)|\$\$(.+?)\$\$|\${INLINE.format('$')}\$", re.MULTILINE | re.DOTALL
)


def on_files(files: Files, config) -> Files:
    """Called by MkDocs once: adds every picture of jobs/ under its path in the repository, and notebooks/."""
    for picture in sorted((ROOT / "jobs").rglob("*.png")):
        files.append(File.generated(config, picture.relative_to(ROOT).as_posix(), abs_src_path=str(picture)))
    for name, text in notebooks.notebooks():
        files.append(File.generated(config, f"notebooks/{name}", content=text))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Called by MkDocs for each page; code is left alone."""

    def replaced(found: re.Match) -> str:
        code, _, display, inline = found.groups()
        if code is not None:
            return code
        formula = " ".join(convert((display or inline).strip(), display="block" if display else "inline").split())
        # Markdown ends a paragraph at a line that begins with <math>, but not at one that begins with a <span>.
        return formula if display else f"<span>{formula}</span>"

    markdown = re.sub(r"\]\((?:\.\./){3}(jobs/[^)]+\.png)\)", r"](\1)", markdown)
    markdown = re.sub(r"\]\((?:\.\./){3}jobs/examples/(\w+)\.py\)", r"](notebooks/\1.ipynb)", markdown)
    return PARTS.sub(replaced, markdown)
