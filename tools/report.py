"""The paper beside the runs: one self-contained HTML page with every figure, number, verdict, parameter and run time.

    python tools/report.py results/paper [--output results/paper/report]

Makes all figures anew.  What has not been run yet is left out, and said.
"""

from __future__ import annotations

import argparse
import base64
import csv
import html
import sys
import tomllib
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import figures
from plotting import Findings

from pgfmd.errors import InputError
from pgfmd.io.results import Results

CLAIMS = Path(__file__).with_name("paper.toml")

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #111; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.4rem; border-top: 1px solid #bbb; padding-top: 1rem; }
img { max-width: 100%; } table { border-collapse: collapse; margin: .6rem 0; font-size: .9rem; }
td, th { border-bottom: 1px solid #ddd; padding: .2rem .7rem .2rem 0; text-align: left; vertical-align: top; }
td.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
.agrees { color: #005b96; font-weight: 600; } .differs { color: #b34700; font-weight: 600; }
.small { color: #555; font-size: .85rem; }
@media print { h2, img, tr { break-inside: avoid; } h2 { break-after: avoid; } }
"""


@dataclass(frozen=True)
class Claim:
    """A number of the paper: it agrees if the measured one lies in `expected`, widened by two standard errors."""

    what: str
    paper: str
    finding: str
    expected: tuple[float, float] | None = None
    why: str = ""  # said where it differs

    def verdict(self, findings: Findings) -> str:
        """ "agrees" or "differs"; empty if nothing was claimed."""
        if self.expected is None:
            return ""
        value, error = findings[self.finding].value, findings[self.finding].error
        low, high = self.expected
        return "agrees" if low - 2 * (error or 0) <= value <= high + 2 * (error or 0) else "differs"


@dataclass(frozen=True)
class Figure:
    """One figure of the report: the tool that makes it from which runs, and what it is held against."""

    title: str
    text: str
    tool: str
    runs: tuple[str, ...]  # patterns of result folders
    claims: tuple[Claim, ...]
    options: dict = field(default_factory=dict)
    name: str = ""  # of the picture, if it is not that of the tool

    @property
    def picture(self) -> str:
        """File name of the picture, without its ending."""
        return self.name or self.tool

    def make(self, folders: list[Path], output: Path) -> Findings:
        """Draw it."""
        sheet = figures.draw(self.tool, folders, **self.options)
        sheet.save(output, self.picture)
        return sheet.findings


def read_figures(path: Path) -> list[Figure]:
    """The figures of a file such as tools/paper.toml."""
    with open(path, "rb") as file:
        tables = tomllib.load(file)["figure"]
    return [Figure(**table | {"claims": tuple(Claim(**claim) for claim in table["claims"])}) for table in tables]


def write_report(folder: Path, output: Path, claims: Path = CLAIMS) -> Path:
    """Make every figure that the runs in `folder` allow, and report.html, report.csv; the path of the page."""
    output.mkdir(parents=True, exist_ok=True)
    parts, rows = [], []
    for figure in read_figures(claims):
        folders = sorted(path for pattern in figure.runs for path in folder.glob(pattern) if _complete(path))
        try:
            findings = figure.make(folders, output) if folders else None
        except InputError as error:
            parts.append(_missing(figure, f"Cannot be drawn: {error}."))
            continue
        if findings is None:
            parts.append(_missing(figure, "Not run yet."))
        else:
            rows += _verdicts(figure, findings)
            parts.append(_section(figure, folders, findings, output))
    everything = sorted(path for path in folder.iterdir() if _complete(path))
    page = [
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>The paper, reproduced</title>',
        f"<style>{STYLE}</style>",
        "<h1>Elastic contact of rough surfaces: the paper, reproduced</h1>",
        _introduction(everything, rows),
        *parts,
        "<h2>Parameters and run times</h2>",
        _runs(everything),
        "</html>\n",
    ]
    path = output / "report.html"
    path.write_text("\n".join(page), encoding="utf-8")
    with open(output / "report.csv", "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["figure", "quantity", "paper", "measured", "verdict", "why"])
        table.writerows(rows)
    return path


def _complete(path: Path) -> bool:
    try:
        return path.is_dir() and Results(path).status == "complete"
    except InputError:
        return False


def _verdicts(figure: Figure, findings: Findings) -> list[tuple[str, str, str, str, str, str]]:
    """Figure, quantity, paper, measured, verdict and why, for each claim whose number was found."""
    rows = []
    for claim in figure.claims:
        if claim.finding in findings:
            verdict = claim.verdict(findings)
            why = claim.why if verdict == "differs" else ""
            rows.append((figure.title, claim.what, claim.paper, findings.text(claim.finding), verdict, why))
    return rows


def _table(rows) -> str:
    lines = ["<table><tr><th>quantity<th>paper<th>here<th>verdict</tr>"]
    for _, what, paper, measured, verdict, why in rows:
        reason = f'<br><span class="small">{html.escape(why)}</span>' if why else ""
        lines.append(
            f'<tr><td>{html.escape(what)}<td>{html.escape(paper)}<td class="n">{html.escape(measured)}'
            f'<td><span class="{verdict}">{verdict}</span>{reason}</tr>'
        )
    return "\n".join([*lines, "</table>"])


def _missing(figure: Figure, reason: str) -> str:
    return f"<h2>{html.escape(figure.title)}</h2><p>{html.escape(reason)}</p>"


def _section(figure: Figure, folders: list[Path], findings: Findings, output: Path) -> str:
    picture = base64.b64encode((output / f"{figure.picture}.png").read_bytes()).decode()
    title = html.escape(figure.title)
    return "\n".join(
        [
            f"<h2>{title}</h2>",
            f"<p>{html.escape(figure.text)}</p>",
            f'<p><img alt="{title}" src="data:image/png;base64,{picture}"></p>',
            _table(_verdicts(figure, findings)),
            f'<p class="small">Drawn by tools/{figure.tool}.py; data in {figure.picture}.csv. '
            f"Runs: {', '.join(path.name for path in folders)}; {_duration(sum(map(_seconds, folders)))} together.</p>",
        ]
    )


def _introduction(folders: list[Path], rows) -> str:
    counts = {verdict: sum(row[4] == verdict for row in rows) for verdict in ("agrees", "differs")}
    about = Results(folders[0]).provenance
    worst = max(float(Results(path).loads["certified_error"].max()) for path in folders)
    return f"""<p>Campañá, Müser &amp; Robbins, <i>J. Phys.: Condens. Matter</i> <b>20</b>, 354013 (2008),
<a href="https://doi.org/10.1088/0953-8984/20/35/354013">doi:10.1088/0953-8984/20/35/354013</a>, against {len(folders)}
runs of pgfmd {about["softwareVersion"]}. {counts["agrees"]} statements agree, {counts["differs"]} differ; the tables
say why. Nothing was fitted to the paper. Numbers with ± are means over seeds with their standard error; “agrees”
allows for the paper's own uncertainty and two standard errors.</p>
<p>λ = μ = 1, so that E' = 8/3; rms slope 0.031; lengths in grid spacings a. λ_s = a means every mode of the grid,
corners included. Loads are those that give the contact areas named. Largest certified relative energy error of any run:
{worst:.1e}. All runs together: {_duration(sum(map(_seconds, folders)))} on {about["ranks"]} rank(s) ×
{about["threads"]} thread(s).</p>"""


def _runs(folders: list[Path]) -> str:
    lines = [
        "<table><tr><th>run<th>grid<th>H<th>λ_s / a<th>seed<th>wall<th>contact areas<th>pressures"
        "<th>certified<th>transforms<th>solve / s<th>whole run / s</tr>"
    ]
    for path in folders:
        results = Results(path)
        surface, wall, loads = results.job["surface"], results.job["wall"], results.loads
        kind = f"ζ = {wall['zeta']:g}" if "zeta" in wall else wall["kind"]
        cells = [
            path.name, " × ".join(map(str, results.shape)), f"{surface['hurst']:g}", f"{surface['lambda_s']:g}",
            surface["seed"], kind, ", ".join(f"{value:.3f}" for value in loads["contact_area"]),
            ", ".join(f"{value:.4g}" for value in loads["mean_pressure"]), f"{loads['certified_error'].max():.0e}",
            f"{loads['transforms'].sum():.0f}", f"{loads['seconds'].sum():.1f}", f"{_seconds(path):.0f}",
        ]  # fmt: skip
        lines.append("<tr>" + "".join(f"<td>{html.escape(str(cell))}" for cell in cells) + "</tr>")
    return "\n".join([*lines, "</table>"])


def _seconds(path: Path) -> float:
    """Wall time of a run, from its first to its last entry."""
    about = Results(path).provenance
    return (datetime.fromisoformat(about["finished"]) - datetime.fromisoformat(about["date"])).total_seconds()


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def main(arguments: list[str] | None = None) -> int:
    """The command line; exit code 0, or 2 if the folder holds no run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", type=Path, metavar="DIR", help="folder of the result folders, as jobs/paper.sh makes it"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the report (default: DIR/report)")
    options = parser.parse_args(arguments)
    if not options.runs.is_dir() or not any(map(_complete, options.runs.iterdir())):
        print(f"report.py: error: {options.runs}: holds no complete run", file=sys.stderr)
        return 2
    print(write_report(options.runs, options.output or options.runs / "report"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
