"""Changes of the code that tests must notice: seeded mutants of pgfmd/, each against the default tests of its line.

    bash tools/bench/coverage.sh && python tools/bench/mutants.py [--seed 1] [--count 60]

A mutant swaps one operator (comparison, arithmetic, and/or) or one condition of a line that coverage.sh counted.  Tests
run in a copy of the checkout: the files whose tests run the line, those that run few lines first, serially, then on
two ranks.  Half an hour for 60.
"""

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("solvers", "observables", "application", "surfaces")
LIMIT = 240  # seconds for the tests of a mutant; one that takes longer hangs
SWAPS = {
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
}  # fmt: skip


def sites(tree: ast.Module) -> list[ast.AST]:
    """Nodes that can be changed, but not those of annotations."""
    hidden = {id(node) for each in ast.walk(tree) for name in ("annotation", "returns")
              if getattr(each, name, None) is not None for node in ast.walk(getattr(each, name))}  # fmt: skip
    nodes = (node for node in ast.walk(tree) if id(node) not in hidden and hasattr(node, "lineno") and _change(node))
    return [node for node in nodes if ast.unparse(getattr(node, "test", node)) != "TYPE_CHECKING"]  # False in runs


def _change(node: ast.AST) -> str | None:
    """What `mutated` would make of a node; None if nothing."""
    if isinstance(node, ast.Compare):
        return type(SWAPS[type(node.ops[0])]()).__name__
    if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPS:
        parts = [each for each in ast.iter_child_nodes(node) if isinstance(each, (ast.JoinedStr, ast.Constant))]
        text = any(not isinstance(getattr(each, "value", ""), (int, float)) for each in parts)
        return None if text else SWAPS[type(node.op)].__name__
    if isinstance(node, (ast.If, ast.While, ast.IfExp)):
        return "Not"
    return None


def mutated(source: str, node: ast.AST) -> str:
    """The source with that node changed, all else as it was."""
    part = node.test if isinstance(node, (ast.If, ast.While, ast.IfExp)) else node
    lines = source.encode().splitlines(keepends=True)
    first = sum(map(len, lines[: part.lineno - 1])) + part.col_offset
    last = sum(map(len, lines[: part.end_lineno - 1])) + part.end_col_offset
    if isinstance(node, ast.Compare):
        node.ops[0] = SWAPS[type(node.ops[0])]()
    elif isinstance(node, (ast.BinOp, ast.BoolOp)):
        node.op = SWAPS[type(node.op)]()
    else:
        part = ast.UnaryOp(ast.Not(), part)
    whole = source.encode()
    return (whole[:first] + f"({ast.unparse(part)})".encode() + whole[last:]).decode()


def tests_of(data: coverage.CoverageData, path: Path, line: int) -> list[str]:
    """Test files that run the line, those that run least of the file first."""
    by_line = data.contexts_by_lineno(str(path))
    names = _files(by_line.get(line, [])) or _files(name for found in by_line.values() for name in found)
    size = {name: sum(any(f".{name}." in f".{each}" for each in found) for found in by_line.values()) for name in names}
    return [f"tests/{name}.py" for name in sorted(names, key=lambda name: size[name])]


def _files(contexts: Iterable[str]) -> set[str]:
    """Modules of the tests that coverage names as contexts; not that of the documentation's site."""
    return {name.split(".")[-2] for name in contexts if ".test_" in f".{name}"} - {"test_docs"}


def run(folder: Path, ranks: int, words: list[str]) -> str | None:
    """The first test that fails in a folder, on one rank or several; None if all pass."""
    environment = os.environ | {"PYTHONPATH": str(folder), "MPLBACKEND": "Agg"}
    pytest = ["-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *words]
    command = [str(folder / "tests" / "mpirun.sh"), str(ranks), sys.executable, *pytest, "-m", "mpi"]
    if ranks == 1:
        command = [sys.executable, *pytest]
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return "a hang"
    failed = re.findall(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", done.stdout, re.MULTILINE)
    return None if done.returncode in (0, 5) else failed[0] if failed else "an error"


def verdict(folder: Path, root: Path, files: list[str], ignored: list[str]) -> str:
    """How the tests end in the copy; `ignored` gets those that fail without a change, too."""
    for ranks in (1, 2):
        while failed := run(folder, ranks, [*files, *ignored]):
            if "::" not in failed or run(root, ranks, [failed]) is None:
                return f"killed on {ranks} by {failed}"
            ignored.append(f"--deselect={failed}")
    return "survived"


def main() -> int:
    """Draw the mutants, run their tests, and count; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--root", type=Path, default=ROOT, help="where coverage.sh ran")
    options = parser.parse_args()
    chance = random.Random(options.seed)
    data = coverage.CoverageData(str(options.root / ".coverage"))
    data.read()
    drawn = []
    for path in sorted(file for room in ROOMS for file in (options.root / "pgfmd" / room).rglob("*.py")):
        lines = set(data.lines(str(path)) or ())
        nodes = sites(ast.parse(path.read_text()))
        drawn += [(path, number) for number, node in enumerate(nodes) if node.lineno in lines]
    killed, ignored, cache = 0, [], tempfile.TemporaryDirectory()
    os.environ["PGFMD_CACHE"] = cache.name  # one for all: the name of a compiled loop's file is its content
    for path, number in chance.sample(drawn, options.count):
        tree = ast.parse(path.read_text())
        node = sites(tree)[number]
        change, before = _change(node), ast.unparse(node).splitlines()[0]
        files = tests_of(data, path, node.lineno)
        source = mutated(path.read_text(), node)
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder) / "checkout"
            shutil.copytree(options.root, copy, ignore=shutil.ignore_patterns(".git", ".venv", "results", ".coverage*"))
            where = path.relative_to(options.root)
            (copy / where).write_text(source)
            said = verdict(copy, options.root, files, ignored) if files else "survived: no test runs it"
        killed += said.startswith("killed")
        print(json.dumps([f"{where}:{node.lineno}", change, before[:100], said], ensure_ascii=False), flush=True)
    print(f"{killed} of {options.count} killed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
