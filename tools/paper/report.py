"""The paper compared with the runs: one self-contained HTML page with every claim, figure, number and run.

    python tools/paper/report.py results/paper [--output results/paper/report]

Makes anew each figure of which the folder holds runs.  Others stay as they are in the output folder; where it lacks
them, they are taken from jobs/paper/results.  `report.py FOLDER --page` writes the page alone, from the figures and
tables of a report's folder.  Claims and rules are in tools/paper/claims.toml; a note names what has not been run yet.
A browser (Chromium or Chrome), where there is one, prints the page to report.pdf.
"""

import argparse
import base64
import csv
import fnmatch
import html
import json
import math
import multiprocessing
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "plots"))
import claims  # noqa: E402
import figures  # noqa: E402
from claims import Claim  # noqa: E402
from formulas import marked  # noqa: E402
from plotting import Finding, Findings  # noqa: E402

from pgfmd.application.results import Results
from pgfmd.errors import InputError

CLAIMS = Path(__file__).with_name("claims.toml")
COMMITTED = Path(__file__).resolve().parents[2] / "jobs" / "paper" / "results"

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
RUNS = ("run", "grid", "H", "lambda_s", "seed", "wall", "contact_areas", "pressures", "certified", "transforms",
        "solve_s", "run_s", "version")  # fmt: skip

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #111; }
math { font-family: "Cambria Math", "STIX Two Math", "Latin Modern Math", "DejaVu Math TeX Gyre", math; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; border-top: 1px solid #bbb; padding-top: 1rem; }
img { max-width: 100%; width: calc(1.4 * var(--width)); }
table { border-collapse: collapse; margin: .6rem 0; font-size: .88em; width: 100%; }
td, th { border-bottom: 1px solid #ddd; padding: .2rem .7rem .2rem 0; text-align: left; vertical-align: top; }
td.n { white-space: nowrap; font-variant-numeric: tabular-nums; } .v { font-weight: 600; white-space: nowrap; }
.agrees { color: #005b96; } .differs { color: #b34700; } .identity, .cannot { color: #555; }
.violated, .not { color: #b00020; } .small { color: #555; font-size: .9em; } td .small { font-size: 1em; }
.runs { font-size: .75em; } .runs td:nth-child(-n+6), .runs td:nth-last-child(-n+3) { white-space: nowrap; }
.narrow { display: grid; grid-template: auto 1fr / max-content 1fr; column-gap: 1.5rem; }
.narrow > :nth-child(2) { grid-column: 1; grid-row: 1 / 3; } .narrow > :not(:nth-child(2)) { grid-column: 2; }
th.part { width: 36%; } th.paper { width: 12%; } th.number { width: 22%; }
@page { size: A4; margin: 14mm; }
@media print { body { font-size: 9pt; max-width: none; margin: 0; padding: 0; } img, tr, .top { break-inside: avoid; }
  img { width: var(--width); } h2 { margin-top: 5mm; padding-top: 2mm; }
  h2, h2 + p, h3, .head, tr:first-child { break-after: avoid; } .runs { font-size: .66em; }
  p { margin: 1.5mm 0; orphans: 3; widows: 3; } table { margin: 1.5mm 0; } td, th { padding: .2mm 2mm .2mm 0; } }
"""


@dataclass(frozen=True)
class Figure:
    """One figure of the report: the tool that makes it from which runs, with which options."""

    key: str
    title: str
    tool: str
    runs: tuple[str, ...]  # patterns of result folders
    text: str = ""
    options: dict = field(default_factory=dict)

    @property
    def picture(self) -> str:
        """File name of the picture, without its ending."""
        return f"{self.key}_{self.tool}"

    def folders(self, root: Path) -> list[Path]:
        """The complete runs that it takes."""
        return sorted({path for pattern in self.runs for path in root.glob(pattern) if _complete(path)})


def read_figures(path: Path) -> list[Figure]:
    """The figures of a file such as tools/paper/claims.toml."""
    with open(path, "rb") as file:
        tables = tomllib.load(file)["figure"]
    return [Figure(**table) for table in tables]


def read_words(path: Path, name: str) -> list[str]:
    """Sentences of a file such as tools/paper/claims.toml: "history" of the rules, or "departures" from the paper."""
    with open(path, "rb") as file:
        return tomllib.load(file).get(name, [])


@dataclass(frozen=True)
class Drawn:
    """What the report needs of a figure that has been drawn, or why it cannot be."""

    findings: Findings
    notes: list[str]
    missing: str = ""


def draw(figure: Figure, folder: Path, output: Path) -> str:
    """Draw a figure of the runs in `folder`, if there are any, into the folder `output`; why it cannot be drawn."""
    folders = figure.folders(folder)
    try:
        if folders:
            figures.draw(figure.tool, folders, **figure.options).save(output, figure.picture)
    except InputError as error:
        return str(error)
    return ""


def drawn_before(figure: Figure, output: Path, missing: str = "") -> Drawn:
    """What is in the folder of the report."""
    path = output / f"{figure.picture}.json"
    if missing or not path.exists():
        return Drawn(Findings(), [], missing or "not run yet")
    content = json.loads(path.read_text(encoding="utf-8"))
    findings = Findings()
    for name, number in content["numbers"].items():
        findings[name] = Finding(**number | {"values": tuple(number["values"]), "others": tuple(number["others"])})
    return Drawn(findings, content["notes"])


def write_report(folder: Path, output: Path, source: Path = CLAIMS, *, small: bool = False, jobs: int = 1) -> Path:
    """Make every figure that the runs in `folder` allow, `jobs` at a time, and the page; the path of the page."""
    output.mkdir(parents=True, exist_ok=True)
    plan = read_figures(source)
    tasks = [(figure, folder, output) for figure in plan]
    if jobs > 1:
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            missing = pool.starmap(draw, tasks, chunksize=1)
    else:
        missing = [draw(*task) for task in tasks]
    taken = _take(plan, COMMITTED, output)
    _write_runs(output / "runs.csv", folder, taken)
    return write_page(output, source, small=small, missing=missing)


def write_page(output: Path, source: Path = CLAIMS, *, small: bool = False, missing: Iterable[str] = ()) -> Path:
    """Write report.html, report.csv and, with a browser, report.pdf from the figures and tables in the folder `output`.

    missing : why figures could not be drawn, in their order
    """
    plan = read_figures(source)
    asked, news = claims.read(source, {figure.key for figure in plan}, small)
    reasons = list(missing) or [""] * len(plan)
    drawn = {figure.key: drawn_before(figure, output, why) for figure, why in zip(plan, reasons, strict=True)}
    findings = {key: result.findings for key, result in drawn.items() if not result.missing}
    with open(output / "runs.csv", encoding="utf-8") as file:
        runs = list(csv.DictReader(file))
    _write_table(output / "report.csv", asked, findings)
    page = [
        '<!doctype html><html lang="en"><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>The paper, reproduced</title><style>{STYLE}</style>",
        "<h1>Elastic contact of rough surfaces: the paper, reproduced</h1>",
        _introduction(runs, asked, findings),
        _news(news, findings),
        _summary(asked, findings),
        *(_section(figure, runs, drawn, asked, findings, output) for figure in plan),
        _method(source),
        _departures(read_words(source, "departures")),
        _second_reader(source.with_name("second_reader.toml"), asked, findings),
        _runs(runs),
        "</html>\n",
    ]
    path = output / "report.html"
    path.write_text("\n".join(page), encoding="utf-8")
    _print(path)
    return path


def _print(page: Path):
    """The page as a PDF beside it, by a browser; without one, nothing."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        return
    with tempfile.TemporaryDirectory() as profile:
        words = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer",
                 f"--user-data-dir={profile}", f"--print-to-pdf={page.with_suffix('.pdf').resolve()}",
                 page.resolve().as_uri()]  # fmt: skip
        subprocess.run(words, capture_output=True, timeout=300, check=False)


def _take(plan: Iterable[Figure], source: Path, output: Path) -> dict[str, dict]:
    """Copy each figure that the folder `output` lacks from the folder `source`; returns the rows of its runs."""
    rows, known = {}, _rows(source / "runs.csv")
    for figure in plan:
        if source != output and not (output / f"{figure.picture}.json").exists():
            for path in source.glob(f"{figure.picture}[._]*"):
                shutil.copy(path, output / path.name)
            rows |= {run: row for run, row in known.items()
                     if any(fnmatch.fnmatchcase(run, pattern) for pattern in figure.runs)}  # fmt: skip
    return rows


def _rows(path: Path) -> dict[str, dict]:
    """The rows of a table of runs, by their names; none if there is no table."""
    if not path.exists():
        return {}
    with open(path, encoding="utf-8") as file:
        return {row["run"]: row for row in csv.DictReader(file)}


def _write_runs(path: Path, folder: Path, rows: dict[str, dict]):
    """Write one row for each complete run of the folder; those of other runs are in `rows` or in the file already."""
    rows |= _rows(path)
    rows |= {run.name: _row(run) for run in folder.iterdir() if _complete(run)}
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, RUNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows[name] for name in sorted(rows))


def _row(path: Path) -> dict:
    results = Results(path)
    surface, wall, loads = results.job["surface"], results.job["wall"], results.loads
    areas = loads["contact_area"] if "zeta" not in wall else []
    values = (
        path.name, " × ".join(map(str, results.shape)), surface.get("hurst", ""), surface.get("lambda_s", ""),
        surface.get("seed", ""), f"ζ = {wall['zeta']:g}" if "zeta" in wall else wall["kind"],
        " ".join(f"{value:.3f}" for value in areas), " ".join(f"{value:.4g}" for value in loads["mean_pressure"]),
        f"{loads['certified_error'].max():.1e}", f"{loads['transforms'].sum():.0f}", f"{loads['seconds'].sum():.1f}",
        f"{_seconds(path):.0f}", results.provenance.get("softwareVersion", "?"),
    )  # fmt: skip
    return dict(zip(RUNS, values, strict=True))


def _complete(path: Path) -> bool:
    try:
        return path.is_dir() and Results(path).status == "complete"
    except InputError:
        return False


def _write_table(path: Path, asked: Iterable[Claim], findings: dict[str, Findings]):
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow("claim kind verdict column part paper measured seeds choices samples part_verdict".split())
        for claim in asked:
            verdict = claim.verdict(findings)
            for part in claim.parts:
                found = part.measured(findings)
                numbers = ["", "", "", ""] if found is None else [
                    *("" if v is None else f"{v:.10g}" for v in (found.value, found.seeds, found.choices)), found.count
                ]  # fmt: skip
                table.writerow([claim.number, claim.kind, verdict, part.column, part.what, part.expectation(), *numbers,
                                part.verdict(found)])  # fmt: skip


def _introduction(runs: list[dict], asked: list[Claim], findings: dict[str, Findings]) -> str:
    counts = Counter(claim.verdict(findings) for claim in asked if claim.kind == "result")
    versions = ", ".join(sorted({row["version"] for row in runs}))
    worst = max(float(row["certified"]) for row in runs)
    said = ", ".join(f"{verdict}: {counts[verdict]}" for verdict in claims.ORDER if counts[verdict])
    others = len(asked) - counts.total()
    found = marked(
        "It found that the spectra of both fall as one power law, q^(−(1+H)), with H the Hurst exponent of the "
        "surface. Models of overlapping asperities predict q^(−2(1+H)); Persson's theory, corrected for partial "
        "contact, predicts what was found."
    )
    units = marked(
        "E' = 8/3, rms slope 0.031, lengths in grid spacings a; λ_s and λ_l are the shortest and the longest wave of "
        "the surface, f_c is the relative contact area."
    )
    return f"""<p>Campañá, Müser &amp; Robbins, <i>J. Phys.: Condens. Matter</i> <b>20</b>, 354013 (2008),
<a href="https://doi.org/10.1088/0953-8984/20/35/354013">doi:10.1088/0953-8984/20/35/354013</a>, asked how an elastic
solid touches a rigid surface that is rough on many scales: how the pressure is distributed, and how pressure and
contact are correlated in space. {found}</p>
<p>The paper makes {len(asked)} claims that can be tested, and {len(runs)} runs of pgfmd {html.escape(versions)} test
them. Of its {counts.total()} own results: <b>{said}</b>. The other {others} are identities, slips, quotations and one
conjecture. Nothing was fitted to the paper. Each claim is judged under the paper's conditions, with its estimators, at
the accuracy that it gives; where it gives none, at that named under “Here”. A column of its own says what stands beside
a verdict, and what larger cells and better estimators show.</p>
<p class="small">{units} <code>jobs/paper.sh --full</code> makes the figures of the limits; a report without its runs
takes them from <code>jobs/paper/results</code>. Largest certified relative energy error of any run: {worst:.1e}.</p>"""


def _news(news: list[claims.Result], findings: dict[str, Findings]) -> str:
    """What the runs show beyond the paper, each with its numbers."""
    said = "Errors are standard errors over surfaces; the tables below also give the spread over fit ranges."
    lines = [f'<h2>What is new</h2><p class="small">{said}</p>'] if news else []
    for result in news:
        numbers = "; ".join(f"{marked(part.what)}: {_number(part, findings, short=True)}" for part in result.parts)
        lines.append(
            f"<p><b>{marked(result.title)}</b> {marked(result.text)} "
            f'<a href="#{html.escape(result.figure)}">Figure</a>. <span class="small">{numbers}.</span></p>'
        )
    return "\n".join(lines)


def _summary(asked: list[Claim], findings: dict[str, Findings]) -> str:
    """One table for each kind of claim: the paper, the paper's conditions, the limit."""
    lines = ["<h2>The claims</h2>"]
    for kind, title in claims.KINDS.items():
        mine = [claim for claim in asked if claim.kind == kind]
        if not mine:
            continue
        heads = '<th>no.<th class="part">the paper<th class="number">its conditions<th>beside it, and in the limit'
        lines += [f"<h3>{title}</h3>", f"<table><tr>{heads}</tr>"]
        for claim in mine:
            verdict = claim.verdict(findings)
            holds = f": {marked(claim.holds)}" if verdict == claims.IN_A_RANGE and claim.holds else ""
            lines.append(
                f'<tr><td>{claim.number}<td>{marked(claim.says)} (<a href="#{html.escape(claim.figure)}">'
                f"{marked(claim.where)}</a>)<td>{_verdict(verdict)}{holds}"
                f'<br><span class="small">{_worst(claim, findings)}</span>'
                f"<td>{marked(claim.limit or _reason(claim, verdict))}</tr>"
            )
        lines.append("</table>")
    return "\n".join(lines)


def _worst(claim: Claim, findings: dict[str, Findings]) -> str:
    """The deciding number of the worst verdict that lies farthest out, in half widths of what the paper says, and what
    the paper says.
    """

    def distance(part: claims.Part) -> tuple[int, float]:
        number = part.measured(findings)
        low, high = (part.number[0] - part.number[1], part.number[0] + part.number[1]) if part.number else (
            part.range or part.beyond or (0.0, 2.0))  # fmt: skip
        width = (high - low) / 2 if math.isfinite(high - low) else 1.0
        rank = (claims.AGREES, claims.CANNOT_TELL, claims.DIFFERS)
        verdict = part.verdict(number)
        return rank.index(verdict) if verdict in rank else 3, part.outside(number) / width if number else -math.inf

    parts = [part for part in claim.parts if part.column == "paper" and part.expectation()]
    if not parts:
        return ""
    part = max(parts, key=distance)
    return f"{marked(part.what)}: {_number(part, findings)} ({marked(part.expectation())})"


def _number(part: claims.Part, findings: dict[str, Findings], short: bool = False) -> str:
    """A part's number with its errors; `short`: without the spread over choices."""
    number = part.measured(findings)
    number = replace(number, choices=None) if number and short else number
    few = f" ({number.count} surfaces)" if number and number.seeds and number.count < 4 else ""
    return marked(number.text()) + few if number else "not run"


def _reason(claim: Claim, verdict: str) -> str:
    return claim.why if verdict == claims.DIFFERS else claim.decided_by if verdict == claims.CANNOT_TELL else ""


def _method(source: Path) -> str:
    """How verdicts are found, and which commits fixed the rules."""
    rules = "\n".join((claims.__doc__ or "").strip().splitlines()[3:])
    text = " ".join(map(marked, read_words(source, "history")))
    return f"<h2>The rules</h2><p>{text}</p><pre>{html.escape(rules)}</pre>"


def _verdict(verdict: str) -> str:
    return f'<span class="v {verdict.partition(" ")[0]}">{verdict}</span>' if verdict else ""


def _departures(lines: list[str]) -> str:
    listed = "".join(f"<li>{marked(line)}" for line in lines)
    return f"<h2>Where the runs depart from the paper, and by how much</h2><ul>{listed}</ul>" if lines else ""


def _section(figure: Figure, runs: list[dict], drawn: dict[str, Drawn], asked, findings, output: Path) -> str:
    """A figure with its caption, and the claims that stand under it."""
    title = f'<h2 id="{html.escape(figure.key)}">{marked(figure.title)}</h2>'
    mine = [claim for claim in asked if claim.figure == figure.key]
    if missing := drawn[figure.key].missing:
        return f"{title}<p>Cannot be drawn: {html.escape(missing)}.</p>{_claims(mine, findings)}"
    picture = (output / f"{figure.picture}.png").read_bytes()
    width = struct.unpack(">I", picture[16:20])[0] / 300  # inches, as printed in a journal
    mine_runs = [row for row in runs if any(fnmatch.fnmatchcase(row["run"], pattern) for pattern in figure.runs)]
    caption = " ".join(figures.module(figure.tool).CAPTION.split())
    notes = "".join(f" Note: {marked(note)}." for note in drawn[figure.key].notes)
    names = html.escape(", ".join(figure.runs))
    return "\n".join(
        [
            title,
            f'<div class="top{" narrow" * (width < 4)}"><p>{marked(figure.text)}</p>',
            f'<p><img alt="{html.escape(figure.title)}" style="--width: {width:.2f}in" '
            f'src="data:image/png;base64,{base64.b64encode(picture).decode()}"></p>',
            f'<p class="small">{marked(caption)}{notes}</p></div>',
            _table_one(figure, findings) if figure.key == "T1" else "",
            _claims(mine, findings),
            f'<p class="small">tools/plots/{html.escape(figure.tool)}.py; data in {html.escape(figure.picture)}*.csv. '
            f"{len(mine_runs)} runs, {_duration(mine_runs)} together: {names}.</p>",
        ]
    )


def _claims(mine: list[Claim], findings: dict[str, Findings]) -> str:
    lines = []
    for claim in mine:
        verdict = claim.verdict(findings)
        text = [marked(claim.says)]
        if claim.conditions:
            text.append(f'<span class="small">Here: {marked(claim.conditions)}</span>')
        if claim.why and verdict == claims.DIFFERS:
            text.append(f'<span class="small">Why: {marked(claim.why)}</span>')
        if claim.decided_by and verdict == claims.CANNOT_TELL:
            text.append(f'<span class="small">What would decide it: {marked(claim.decided_by)}</span>')
        if claim.limit:
            text.append(f'<span class="small">In the limit: {marked(claim.limit)}</span>')
        lines.append(
            f'<p class="head"><b>Claim {claim.number}</b> ({marked(claim.where)}): {_verdict(verdict)}. '
            f"{' '.join(text)}</p>"
        )
        lines.append(
            '<table><tr><th class="part">number<th class="paper">the paper<th class="number">under its conditions'
            '<th class="number">beside it, and in the limit<th>verdict</tr>'
        )
        for part in claim.parts:
            cells = [_number(part, findings), ""]
            verdict = part.verdict(part.measured(findings)) if part.column == "paper" else ""
            lines.append(
                f'<tr><td>{marked(part.what)}<td class="n">{marked(part.expectation())}'
                + "".join(f'<td class="n">{cell}' for cell in (cells if part.column == "paper" else cells[::-1]))
                + f"<td>{_verdict(verdict)}</tr>"
            )
        lines.append("</table>")
    return "\n".join(lines)


PAPER_TABLE = {"0.3": "1.28(7)", "0.5": "1.52(7)", "0.8": "1.86(12)"}


def _table_one(figure: Figure, findings: dict[str, Findings]) -> str:
    """Table I: the exponents of the joint and separate fits beside the paper's joint ones."""
    found = findings[figure.key]
    lines = ["<table><tr><th>H<th>1 + H<th>paper<th>size<th>joint fit<th>stress<th>contact<th>contact − stress</tr>"]
    for name in found:
        if name.startswith("μ joint, "):
            setting = name.removeprefix("μ joint, ")
            parts = dict(part.split(" = ") for part in setting.split(", ") if " = " in part)
            hurst = parts.get("H", "")
            cells = [
                hurst, f"{1 + float(hurst):g}" if hurst else "", PAPER_TABLE.get(hurst, ""), parts.get("n", ""),
                *(found.text(f"μ {kind}, {setting}") if f"μ {kind}, {setting}" in found else "—"
                  for kind in ("joint", "stress", "contact", "difference")),
            ]  # fmt: skip
            lines.append("<tr>" + "".join(f'<td class="n">{html.escape(cell)}' for cell in cells) + "</tr>")
    return "\n".join(["<p>Table I.</p>", *lines, "</table>"])


def _runs(runs: list[dict]) -> str:
    """A row for the runs that differ by their seeds alone; runs.csv has each of them."""
    lines = [
        "<h2>Runs</h2>",
        f"<p>{len(runs)} runs, {_duration(runs)} together, listed in runs.csv.</p>",
        '<table class="runs">'
        f"<tr><th>runs<th>surfaces<th>grid<th>{marked('H')}<th>{marked('λ_s/a')}<th>wall<th>contact areas"
        f"<th>{marked('10³ p̄')}<th>certified<th>transforms<th>time</tr>",
    ]
    groups = defaultdict(list)
    for row in runs:
        groups[re.sub(r"-s\d+", "", row["run"])].append(row)
    for name, rows in groups.items():
        first = rows[0]
        areas = np.array([row["contact_areas"].split() for row in rows], float)
        cells = [
            html.escape(name), len(rows), first["grid"], first["H"], first["lambda_s"], marked(first["wall"]),
            ", ".join(f"{area:.2g}" for area in areas.mean(axis=0)),
            ", ".join(f"{1e3 * float(load):.3g}" for load in first["pressures"].split()),
            f"{max(float(row['certified']) for row in rows):.0e}",
            f"{np.mean([float(row['transforms']) for row in rows]):.0f}", _duration(rows),
        ]  # fmt: skip
        lines.append("<tr>" + "".join(f"<td>{cell}" for cell in cells) + "</tr>")
    return "\n".join([*lines, "</table>"])


def _second_reader(path: Path, asked: list[Claim], findings: dict[str, Findings]) -> str:
    """Verdicts of a reader beside those of the report."""
    if not path.exists():
        return ""
    with open(path, "rb") as file:
        content = tomllib.load(file)
    ours = {claim.number: claim.verdict(findings) for claim in asked}
    notes = {note["claim"]: note for note in content["note"]}
    apart = [number for number, note in notes.items() if note["verdict"] != ours[number]]
    lines = [
        f"<h2>The second reader</h2><p>{marked(content['how'])} The verdicts agree in {len(ours) - len(apart)} of "
        f"{len(ours)} rows.</p>",
        "<table><tr><th>no.<th>the rules say<th>the reader says<th>reasons</tr>",
    ]
    for number, note in sorted(notes.items()):
        verdicts = f"<td>{_verdict(ours[number])}<td>{_verdict(note['verdict'])}"
        lines.append(f"<tr><td>{number}{verdicts}<td>{marked(note['why'])}</tr>")
    return "\n".join([*lines, "</table>"])


def _seconds(path: Path) -> float:
    """Wall time of a run, from its first to its last entry; 0 for runs whose end is not known."""
    about = Results(path).provenance
    if "finished" not in about:
        return 0.0
    return (datetime.fromisoformat(about["finished"]) - datetime.fromisoformat(about["date"])).total_seconds()


def _duration(runs: list[dict]) -> str:
    seconds = sum(float(row["run_s"]) for row in runs)
    return f"{math.ceil(seconds)} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def main(arguments: list[str] | None = None) -> int:
    """The command line; exit code 0, or 2 if the folder holds no run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", type=Path, metavar="DIR", help="folder of the result folders, as jobs/paper.sh makes it"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the report (default: DIR/report)")
    parser.add_argument("--small", action="store_true", help="the runs are those of jobs/paper.sh --small")
    parser.add_argument("--page", action="store_true", help="DIR is the folder of a report: write its page anew")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="figures at a time (default 1)")
    options = parser.parse_args(arguments)
    wanted = "table runs.csv" if options.page else "complete run"
    found = options.runs.is_dir() and (
        (options.runs / "runs.csv").exists() if options.page else any(map(_complete, options.runs.iterdir()))
    )
    if not found:
        print(f"report.py: error: {options.runs}: holds no {wanted}", file=sys.stderr)
        return 2
    try:
        if options.page:
            print(write_page(options.runs, small=options.small))
        else:
            output = options.output or options.runs / "report"
            print(write_report(options.runs, output, small=options.small, jobs=options.jobs))
    except InputError as error:
        print(f"report.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
