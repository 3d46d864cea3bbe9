"""What the README says is what the program does."""

import dataclasses
import re
import shlex
import subprocess
import sys

import pytest
from conftest import ROOT

from pgfmd.application import cli
from pgfmd.application.job import SECTIONS, parse
from pgfmd.options import key_reference as writer
from pgfmd.options.rules import Rule
from pgfmd.options.section import Kinds

README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", README, re.MULTILINE | re.DOTALL)
KINDS = [choice.kind for table in SECTIONS.values() if isinstance(table, Kinds) for choice in table.choices]


def blocks(language: str) -> list[str]:
    return [text for kind, text in BLOCKS if kind == language]


def commands() -> list[list[str]]:
    """Every call of pgfmd in a block of shell commands, as words; comments and optional parts left out."""
    lines = [line.split("  #")[0].split(" [")[0] for text in blocks("") for line in text.splitlines()]
    calls = [re.search(r"(?:^|; do |-m )pgfmd ([^;|>]*)", line) for line in lines]
    return [shlex.split(call[1]) for call in calls if call]


@pytest.mark.parametrize("text", blocks("toml"))
def test_jobs_are_valid(text):
    """Every TOML block is a whole job."""
    parse(text)


def test_links_lead_somewhere():
    """Every link to a file of this repository, or to a heading; tutorial and tasks on the first screen."""
    links = re.findall(r"\]\(([^)\s]+)\)", README)
    titles = re.findall(r"^#+ (.*)", README, re.MULTILINE)
    headings = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    for link in links:
        if link.startswith("#"):
            assert link[1:] in headings, link
        elif not link.startswith("http"):
            assert (ROOT / link.partition("#")[0]).exists(), link
    first_screen = "\n".join(README.split("\n")[:24])
    assert all(f"tools/docs/pages/{page}.md" in first_screen for page in ("tutorial", "tasks"))


@pytest.mark.parametrize("page", ["README.md", "pgfmd/README.md", "tools/docs/pages/tutorial.md"])
def test_the_number_of_ranks_matters_within_the_tolerance(page):
    """Where a page says how the answer depends on the number of ranks it names the tolerance."""
    text = " ".join((ROOT / page).read_text().split())
    said = re.findall(r"(?:answer|results) (?:do|depend).{100}", text)
    assert said and all("tolerance" in words for words in said), said


def test_every_recipe_installs_this_checkout_itself():
    """Every `pip install` of this package is editable: `pgfmd` and `python -m pgfmd` are the same code."""
    pages = [ROOT / "README.md", *(ROOT / "tools").rglob("*.md"), *(ROOT / "tools").glob("*/*.yml")]
    pages += (ROOT / "tools").glob("*.sh")
    recipe = re.compile(r'pip install .*["\s](?:\.|\$\{root\})(?:\[.*|$)', re.MULTILINE)
    shown = [line for page in pages for line in recipe.findall(page.read_text())]
    assert len(shown) >= 3 and all(" -e " in line for line in shown), shown


def test_there_are_jobs_and_commands():
    """The blocks are found."""
    assert len(blocks("toml")) >= 1 and len(commands()) >= 6 and len(blocks("python")) >= 1


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_commands_exist(words):
    """Every call of pgfmd names a command and options that it knows."""
    if words[0] == "plot":
        assert len(words) == 2 or words[1] in cli._plot([])
    else:
        assert cli._parser().parse_args(words).command == words[0]


@pytest.mark.parametrize("kind", KINDS)
def test_new_jobs_are_valid(kind):
    """`pgfmd new KIND` prints a valid job of every kind, which keeps what `pgfmd plot` shows first."""
    kept = parse(writer.example(SECTIONS.values(), kind)).output
    assert {"height", "pressure", "gap"} <= set(kept.fields) and {"histogram", "spectra"} <= set(kept.observables)


def sections(table) -> list:
    """Every section that a table may be, and those inside it."""
    found = list(table.choices) if isinstance(table, Kinds) else [table]
    inner = [field.metadata["rule"] for kind in found for field in dataclasses.fields(kind)]
    return found + [kind for rule in inner if not isinstance(rule, Rule) for kind in sections(rule)]


def test_every_key_says_what_it_means():
    """No key is without a meaning for the reference, no needed one without an example."""
    for kind in (kind for table in SECTIONS.values() for kind in sections(table)):
        for field in dataclasses.fields(kind):
            if isinstance(field.metadata["rule"], Rule):
                about, example, needed = (field.metadata[name] for name in ("about", "example", "needed"))
                assert about and (example is not None or not needed), f"{kind.where}.{field.name}"


def test_every_number_has_a_unit():
    """Keys whose value is a real number name one of the units that the first lines explain; no other has one."""
    known = {"length", "pressure", "grid spacings", "1", "s", "radians per length"}
    known |= {"pressure*length", "pressure*length^2", "conductivity"}
    for kind in (kind for table in SECTIONS.values() for kind in sections(table)):
        for field in dataclasses.fields(kind):
            rule = field.metadata["rule"]
            if isinstance(rule, Rule):
                assert (field.metadata["unit"] in known) == ("a number" in rule.allowed), f"{kind.where}.{field.name}"
    assert all(f"[{unit}]" in writer.UNITS for unit in ("length", "pressure", "grid spacings", "1"))


def test_scripts_run(tmp_path):
    """The Python blocks run, one after another, on the results of a small run called as in the README."""
    job = tmp_path / "job.toml"
    job.write_text(next(text for text in blocks("toml") if "[surface]" in text))
    small = ["--set", "grid.n=64", "--set", "surface.lambda_s=8"]
    command = [sys.executable, "-m", "pgfmd", "run", str(job), "--output", str(tmp_path / "results" / "quickstart")]
    subprocess.run([*command, *small], cwd=ROOT, check=True, capture_output=True)
    script = "\n".join(blocks("python"))
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, env=None)
