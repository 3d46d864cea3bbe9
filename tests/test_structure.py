"""What a reader may rely on in every file of the package: few parameters, nothing written twice."""

from __future__ import annotations

import ast
import io
import keyword
import tokenize
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "pgfmd"
FILES = sorted(PACKAGE.rglob("*.py"))
MOST_PARAMETERS = 6
LINES = 8  # a run of so many lines of one shape is written once


def parameters(function: ast.FunctionDef) -> list[str]:
    """Names of the parameters, without self."""
    arguments = function.args
    names = [argument.arg for argument in arguments.posonlyargs + arguments.args + arguments.kwonlyargs]
    return [name for name in names if name not in ("self", "cls")]


def test_few_parameters():
    """No function takes more than six parameters, but `api.solve`, the front door for scripts."""
    long = [
        f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}({', '.join(parameters(node))})"
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef) and len(parameters(node)) > MOST_PARAMETERS
    ]
    assert [entry for entry in long if not entry.startswith("api.py")] == []


def shapes(path: Path) -> list[tuple[int, str]]:
    """(line number, shape) of each line of code, names, numbers and texts made alike; no docstrings, no imports."""
    text = path.read_text()
    skipped = set()
    for node in ast.walk(ast.parse(text)):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text or isinstance(node, (ast.Import, ast.ImportFrom)):
            skipped.update(range(node.lineno, node.end_lineno + 1))
    lines = defaultdict(list)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME and not keyword.iskeyword(token.string):
            lines[token.start[0]].append("name")
        elif token.type in (tokenize.NUMBER, tokenize.STRING):
            lines[token.start[0]].append("value")
        elif token.type in (tokenize.NAME, tokenize.OP):
            lines[token.start[0]].append(token.string)
    kept = sorted(number for number in lines if number not in skipped and set(lines[number]) & {"name", "value"})
    return [(number, " ".join(lines[number])) for number in kept]


def test_nothing_is_written_twice():
    """No two places share eight lines of code, other names and numbers allowed."""
    places = defaultdict(list)
    for path in FILES:
        found = shapes(path)
        for first in range(len(found) - LINES + 1):
            window = found[first : first + LINES]
            if len({shape for _, shape in window}) > LINES // 2:  # a table of like entries is not a copy
                places[tuple(shape for _, shape in window)].append((path, window[0][0], window[-1][0]))
    copies = []
    for found in places.values():
        original, start, stop = found[0]
        for path, first, last in found[1:]:
            if path != original or first > stop:
                copies.append(f"{path.relative_to(PACKAGE)}:{first}-{last} ~ {original.relative_to(PACKAGE)}:{start}")
    assert copies == []


def test_no_two_files_of_the_package_have_one_name():
    """A file is found by its name alone."""
    names = [path.name for path in FILES if path.name != "__init__.py"]
    assert sorted(names) == sorted(set(names))
