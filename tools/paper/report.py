"""The paper compared with the runs: one self-contained HTML page with every claim, figure, number and run.

    python tools/paper/report.py results/paper [--output results/paper/report]

Makes all figures anew.  Claims and rules are in tools/paper/claims.toml; a note names what has not been run yet.
"""

from __future__ import annotations

import argparse
import base64
import csv
import html
import math
import multiprocessing
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "plots"))
import claims  # noqa: E402
import figures  # noqa: E402
from claims import Claim  # noqa: E402
from plotting import Findings  # noqa: E402

from pgfmd.application.results import Results
from pgfmd.errors import InputError

CLAIMS = Path(__file__).with_name("claims.toml")

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #111; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; border-top: 1px solid #bbb; padding-top: 1rem; }
img { max-width: 100%; } table { border-collapse: collapse; margin: .6rem 0; font-size: .88rem; width: 100%; }
td, th { border-bottom: 1px solid #ddd; padding: .2rem .7rem .2rem 0; text-align: left; vertical-align: top; }
td.n { white-space: nowrap; font-variant-numeric: tabular-nums; } .v { font-weight: 600; white-space: nowrap; }
.agrees { color: #005b96; } .differs { color: #b34700; } .identity, .cannot { color: #555; }
.violated, .not { color: #b00020; } .small { color: #555; font-size: .85rem; }
.scroll { overflow-x: auto; }
@media print { body { font-size: 10pt; max-width: none; margin: 0; } h2, img, tr { break-inside: avoid; }
  h2 { break-after: avoid; } .scroll { overflow: visible; font-size: 7pt; } }
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


def read_departures(path: Path) -> list[str]:
    """How the runs depart from the paper."""
    with open(path, "rb") as file:
        return tomllib.load(file).get("departures", [])


@dataclass(frozen=True)
class Drawn:
    """What the report needs of a figure that has been drawn, or why it cannot be."""

    findings: Findings
    notes: list[str]
    missing: str = ""


def draw(figure: Figure, folder: Path, output: Path) -> Drawn:
    """Draw a figure of the runs in `folder` into the folder `output`."""
    folders = figure.folders(folder)
    try:
        if not folders:
            raise InputError("not run yet")
        sheet = figures.draw(figure.tool, folders, **figure.options)
        sheet.save(output, figure.picture)
    except InputError as error:
        return Drawn(Findings(), [], str(error))
    return Drawn(sheet.findings, sheet.notes)


def write_report(folder: Path, output: Path, source: Path = CLAIMS, *, small: bool = False, jobs: int = 1) -> Path:
    """Make every figure that the runs in `folder` allow, `jobs` at a time, and report.html, report.csv; the path of the
    page.
    """
    began = time.perf_counter()
    output.mkdir(parents=True, exist_ok=True)
    plan = read_figures(source)
    asked, news = claims.read(source, {figure.key for figure in plan}, small)
    tasks = [(figure, folder, output) for figure in plan]
    if jobs > 1:
        with multiprocessing.get_context("spawn").Pool(jobs) as pool:
            results = pool.starmap(draw, tasks, chunksize=1)
    else:
        results = [draw(*task) for task in tasks]
    drawn = {figure.key: result for figure, result in zip(plan, results, strict=True)}
    findings = {key: result.findings for key, result in drawn.items() if not result.missing}
    everything = sorted(path for path in folder.iterdir() if _complete(path))
    _write_table(output / "report.csv", asked, findings)
    page = [
        '<!doctype html><html lang="en"><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>The paper, reproduced</title><style>{STYLE}</style>",
        "<h1>Elastic contact of rough surfaces: the paper, reproduced</h1>",
        _introduction(everything, asked, findings),
        _news(news, findings),
        _summary(asked, findings),
        *(_section(figure, folder, drawn, asked, findings, output) for figure in plan),
        _method(source),
        _departures(read_departures(source)),
        _runs(everything, time.perf_counter() - began),
        "</html>\n",
    ]
    path = output / "report.html"
    path.write_text("\n".join(page), encoding="utf-8")
    return path


def _complete(path: Path) -> bool:
    try:
        return path.is_dir() and Results(path).status == "complete"
    except InputError:
        return False


def _write_table(path: Path, asked: Iterable[Claim], findings: dict[str, Findings]):
    with open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(
            [
                "claim",
                "kind",
                "verdict",
                "column",
                "part",
                "paper",
                "measured",
                "seeds",
                "choices",
                "samples",
                "part_verdict",
            ]
        )
        for claim in asked:
            verdict = claim.verdict(findings)
            for part in claim.parts:
                found = part.measured(findings)
                numbers = ["", "", "", ""] if found is None else [
                    *("" if v is None else f"{v:.10g}" for v in (found.value, found.seeds, found.choices)), found.count
                ]  # fmt: skip
                table.writerow([claim.number, claim.kind, verdict, part.column, part.what, part.expectation(), *numbers,
                                part.verdict(found)])  # fmt: skip


def _introduction(folders: list[Path], asked: list[Claim], findings: dict[str, Findings]) -> str:
    counts = Counter(claim.verdict(findings) for claim in asked if claim.kind == "result")
    about = Results(folders[0]).provenance
    version = html.escape(str(about.get("softwareVersion", "?")))
    worst = max(float(Results(path).loads["certified_error"].max()) for path in folders)
    said = ", ".join(f"{verdict}: {counts[verdict]}" for verdict in claims.ORDER if counts[verdict])
    others = len(asked) - counts.total()
    return f"""<p>Campañá, Müser &amp; Robbins, <i>J. Phys.: Condens. Matter</i> <b>20</b>, 354013 (2008),
<a href="https://doi.org/10.1088/0953-8984/20/35/354013">doi:10.1088/0953-8984/20/35/354013</a>, asked how an elastic
solid touches a rigid surface that is rough on many scales: how the pressure is distributed, and how pressure and
contact are correlated in space. It found that the spectra of both fall as one power law, q<sup>−(1+H)</sup>, with H the
Hurst exponent of the surface. Models of overlapping asperities predict q<sup>−2(1+H)</sup>; Persson's theory, corrected
for partial contact, predicts what was found.</p>
<p>The paper makes {len(asked)} claims that can be tested, and {len(folders)} runs of pgfmd {version} test them. Of its
{counts.total()} own results: <b>{said}</b>. {others} claims more are identities, slips, quotations and one conjecture.
Nothing was fitted to the paper. Each claim is judged under the paper's conditions, with its estimators, at the accuracy
that it gives or with which its figures can be read. A column of its own says what better numbers show.</p>
<p class="small">E' = 8/3, rms slope 0.031, lengths in grid spacings a; λ_s and λ_l are the shortest and the longest
wave of the surface, f_c is the relative contact area. Largest certified relative energy error of any run:
{worst:.1e}.</p>"""


def _news(news: list[claims.Result], findings: dict[str, Findings]) -> str:
    """What the runs show beyond the paper, each with its numbers."""
    lines = ["<h2>What is new</h2>"] if news else []
    for result in news:
        numbers = "; ".join(f"{html.escape(part.what)}: {_number(part, findings)}" for part in result.parts)
        lines.append(
            f"<p><b>{html.escape(result.title)}</b> {html.escape(result.text)} "
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
        lines += [f"<h3>{title}</h3>", "<table><tr><th>no.<th>the paper<th>under its conditions<th>in the limit</tr>"]
        for claim in mine:
            verdict = claim.verdict(findings)
            holds = f": {html.escape(claim.holds)}" if verdict == claims.IN_A_RANGE and claim.holds else ""
            lines.append(
                f'<tr><td>{claim.number}<td>{html.escape(claim.says)} (<a href="#{html.escape(claim.figure)}">'
                f"{html.escape(claim.where)}</a>)<td>{_verdict(verdict)}{holds}"
                f'<br><span class="small">{_worst(claim, findings)}</span>'
                f"<td>{html.escape(claim.limit or _reason(claim, verdict))}</tr>"
            )
        lines.append("</table>")
    return "\n".join(lines)


def _worst(claim: Claim, findings: dict[str, Findings]) -> str:
    """The deciding number that lies farthest out, in half widths of what the paper says, and what the paper says."""

    def distance(part: claims.Part) -> float:
        number = part.measured(findings)
        return part.outside(number) if number else -math.inf

    parts = [part for part in claim.parts if part.column == "paper" and part.expectation()]
    if not parts:
        return ""
    part = max(parts, key=distance)
    return f"{html.escape(part.what)}: {_number(part, findings)} ({html.escape(part.expectation())})"


def _number(part: claims.Part, findings: dict[str, Findings]) -> str:
    number = part.measured(findings)
    return html.escape(number.text()) if number else "not run"


def _reason(claim: Claim, verdict: str) -> str:
    return claim.why if verdict == claims.DIFFERS else claim.decided_by if verdict == claims.CANNOT_TELL else ""


def _method(source: Path) -> str:
    """How verdicts are found, and the commit that fixed the rules."""
    rules = "\n".join((claims.__doc__ or "").strip().splitlines()[3:])
    commit = _commit_of(source)
    fixed = f" They were last changed in commit {html.escape(commit)}." if commit else ""
    text = f"They were fixed before the runs that they judge.{fixed}"
    return f"<h2>The rules</h2><p>{text}</p><pre>{html.escape(rules)}</pre>"


def _commit_of(source: Path) -> str:
    """The last commit that changed the claims or their rules, with its date; empty outside of a repository."""
    words = ["git", "log", "-1", "--format=%h of %cs", "--", source.name, "claims.py"]
    try:
        done = subprocess.run(words, cwd=source.parent, capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


def _verdict(verdict: str) -> str:
    return f'<span class="v {verdict.partition(" ")[0]}">{verdict}</span>' if verdict else ""


def _departures(lines: list[str]) -> str:
    listed = "".join(f"<li>{html.escape(line)}" for line in lines)
    return f"<h2>Where the runs depart from the paper, and by how much</h2><ul>{listed}</ul>" if lines else ""


def _section(figure: Figure, folder: Path, drawn: dict[str, Drawn], asked, findings, output: Path) -> str:
    """A figure with its caption, and the claims that stand under it."""
    title = f'<h2 id="{html.escape(figure.key)}">{html.escape(figure.title)}</h2>'
    mine = [claim for claim in asked if claim.figure == figure.key]
    if missing := drawn[figure.key].missing:
        return f"{title}<p>Cannot be drawn: {html.escape(missing)}.</p>{_claims(mine, findings)}"
    picture = base64.b64encode((output / f"{figure.picture}.png").read_bytes()).decode()
    runs = figure.folders(folder)
    caption = " ".join(figures.module(figure.tool).CAPTION.split())
    notes = "".join(f" Note: {html.escape(note)}." for note in drawn[figure.key].notes)
    names = html.escape(", ".join(figure.runs))
    return "\n".join(
        [
            title,
            f"<p>{html.escape(figure.text)}</p>",
            f'<p><img alt="{html.escape(figure.title)}" src="data:image/png;base64,{picture}"></p>',
            f'<p class="small">{html.escape(caption)}{notes}</p>',
            _table_one(figure, findings) if figure.key == "T1" else "",
            _claims(mine, findings),
            f'<p class="small">tools/plots/{html.escape(figure.tool)}.py; data in {html.escape(figure.picture)}*.csv. '
            f"{len(runs)} runs, {_duration(sum(map(_seconds, runs)))} together: {names}.</p>",
        ]
    )


def _claims(mine: list[Claim], findings: dict[str, Findings]) -> str:
    lines = []
    for claim in mine:
        verdict = claim.verdict(findings)
        text = [html.escape(claim.says)]
        if claim.conditions:
            text.append(f'<span class="small">Here: {html.escape(claim.conditions)}</span>')
        if claim.why and verdict == claims.DIFFERS:
            text.append(f'<span class="small">Why: {html.escape(claim.why)}</span>')
        if claim.decided_by and verdict == claims.CANNOT_TELL:
            text.append(f'<span class="small">What would decide it: {html.escape(claim.decided_by)}</span>')
        if claim.limit:
            text.append(f'<span class="small">In the limit: {html.escape(claim.limit)}</span>')
        lines.append(
            f"<p><b>Claim {claim.number}</b> ({html.escape(claim.where)}): {_verdict(verdict)}. {' '.join(text)}</p>"
        )
        lines.append("<table><tr><th>number<th>the paper<th>under its conditions<th>in the limit<th>verdict</tr>")
        for part in claim.parts:
            cells = [_number(part, findings), ""]
            verdict = part.verdict(part.measured(findings)) if part.column == "paper" else ""
            lines.append(
                f'<tr><td>{html.escape(part.what)}<td class="n">{html.escape(part.expectation())}'
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


def _runs(folders: list[Path], seconds: float) -> str:
    total = sum(map(_seconds, folders))
    lines = [
        "<h2>Runs</h2>",
        f"<p>{len(folders)} runs, {_duration(total)} together (as many at a time as there are cores); figures and this "
        f"page: {_duration(seconds)}.</p>",
        '<div class="scroll"><table><tr><th>run<th>grid<th>H<th>λ_s / a<th>seed<th>wall<th>contact areas<th>pressures'
        "<th>certified<th>transforms<th>solve / s<th>run / s</tr>",
    ]
    for path in folders:
        results = Results(path)
        surface, wall, loads = results.job["surface"], results.job["wall"], results.loads
        kind = f"ζ = {wall['zeta']:g}" if "zeta" in wall else wall["kind"]
        areas = loads["contact_area"] if "zeta" not in wall else []
        cells = [
            path.name, " × ".join(map(str, results.shape)), _short(surface.get("hurst")),
            _short(surface.get("lambda_s")),
            surface.get("seed", ""), kind, ", ".join(f"{value:.3f}" for value in areas),
            ", ".join(f"{value:.4g}" for value in loads["mean_pressure"]), f"{loads['certified_error'].max():.0e}",
            f"{loads['transforms'].sum():.0f}", f"{loads['seconds'].sum():.1f}", f"{_seconds(path):.0f}",
        ]  # fmt: skip
        lines.append("<tr>" + "".join(f"<td>{html.escape(str(cell))}" for cell in cells) + "</tr>")
    return "\n".join([*lines, "</table></div>"])


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def _seconds(path: Path) -> float:
    """Wall time of a run, from its first to its last entry; 0 for runs whose end is not known."""
    about = Results(path).provenance
    if "finished" not in about:
        return 0.0
    return (datetime.fromisoformat(about["finished"]) - datetime.fromisoformat(about["date"])).total_seconds()


def _duration(seconds: float) -> str:
    return f"{math.ceil(seconds)} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def main(arguments: list[str] | None = None) -> int:
    """The command line; exit code 0, or 2 if the folder holds no run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", type=Path, metavar="DIR", help="folder of the result folders, as jobs/paper.sh makes it"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the report (default: DIR/report)")
    parser.add_argument("--small", action="store_true", help="the runs are those of jobs/paper.sh --small")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="figures at a time (default 1)")
    options = parser.parse_args(arguments)
    if not options.runs.is_dir() or not any(map(_complete, options.runs.iterdir())):
        print(f"report.py: error: {options.runs}: holds no complete run", file=sys.stderr)
        return 2
    try:
        output = options.output or options.runs / "report"
        print(write_report(options.runs, output, small=options.small, jobs=options.jobs))
    except InputError as error:
        print(f"report.py: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
