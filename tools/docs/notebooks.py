"""Jupyter notebooks of the scripts in jobs/examples/, which remain the only source.

    python tools/docs/notebooks.py [FOLDER]     # writes NAME.ipynb; the site has them too
"""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "jobs" / "examples"
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


def notebook(script: str) -> str:
    """Text of the notebook, without outputs: a cell from each `# %%` to the next, whose title becomes a heading."""
    cells = [{"id": str(index), "metadata": {}, **cell} for index, cell in enumerate(_cells(script))]
    parts = {"cells": cells, "metadata": {"kernelspec": KERNEL}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps(parts, indent=1, ensure_ascii=False) + "\n"


def _cells(script: str) -> Iterator[dict]:
    _, *parts = re.split(r"^# %% *(.*)\n", script, flags=re.MULTILINE)
    for title, text in zip(parts[::2], parts[1::2], strict=True):
        if title == "[markdown]":
            yield {"cell_type": "markdown", "source": re.sub("^# ?", "", text.strip(), flags=re.MULTILINE)}
            continue
        if title:
            yield {"cell_type": "markdown", "source": f"## {title}"}
        yield {"cell_type": "code", "source": text.strip(), "outputs": [], "execution_count": None}


def notebooks() -> Iterator[tuple[str, str]]:
    """File name and text of each."""
    for path in sorted(EXAMPLES.glob("*.py")):
        yield f"{path.stem}.ipynb", notebook(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    folder = Path(*sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in notebooks():
        (folder / name).write_text(text, encoding="utf-8")
