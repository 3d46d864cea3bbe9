"""Formulas in plain sentences, such as “C_σ/σ_c² ≤ m₂ C_c at λ_s = 8 a”, as MathML in HTML."""

import html
import re
import unicodedata

SYMBOL = re.compile(
    r"[κλμστζν∝⟨√]|Δ|\w̄|[A-Z]̃|ḡ|E'|_[a-zσ]|[²³₀-₉]|(?<![^\W\d_])H(?![^\W\d_])|^[(|]*[Pkqfgn](?:$|[*/(),.;:=|])"
)
JOINING = re.compile(r"[=≤≥<>+−±·×/∝≈…]|[−-]?[(|]?\d[\d.]*[)|]?|[(|]?\d+\(\d+")
OPERATORS = "=≤≥<>+−±·×/∝≈…→|,-"
RAISED = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹", "0123456789", strict=True))
LOWERED = dict(zip("₀₁₂₃₄₅₆₇₈₉", "0123456789", strict=True))


def marked(text: str) -> str:
    """HTML of a sentence: its formulas in MathML, everything else escaped."""
    words = re.split(r"(\s+)", unicodedata.normalize("NFD", text))
    pieces: list[str] = []
    run: list[str] = []

    def flush():
        if run:
            pieces.append(_sentence("".join(run)))
            run.clear()

    for word, space in zip(words[::2], [*words[1::2], ""], strict=True):
        bare = word.rstrip(",.;:")
        unit = bare.rstrip(")") == "a" and any(JOINING.fullmatch(part) for part in "".join(run).split()[-1:])
        if not (unit or SYMBOL.search(word) or JOINING.fullmatch(bare)):
            flush()
            pieces.append(html.escape(unicodedata.normalize("NFC", word + space)))
            continue
        run.append(word + space)
        if bare != word:
            flush()
    flush()
    return "".join(pieces)


def _sentence(run: str) -> str:
    """A run of words of a formula, with what does not belong to it on either side."""
    if not any(map(SYMBOL.search, run.split())):
        return html.escape(unicodedata.normalize("NFC", run))
    opened: list[int] = []
    for at, sign in enumerate(run):
        if sign == "(":
            opened.append(at)
        elif sign == ")" and opened:
            opened.pop()
    if opened:  # closed by a word: the bracket is not of the formula
        return f"{_sentence(run[: opened[0]])}({_sentence(run[opened[0] + 1 :])}"
    end = len(run.rstrip(" ,.;:\n"))
    start = 0
    while end > start and run[:end][-1] == ")" and run[start:end].count(")") > run[start:end].count("("):
        end -= 1
    formula = run[start:end]
    tail = re.search(r"[\s=≤≥<>+−±·×/∝≈…]*$", formula)
    formula, rest = formula[: tail.start()], tail[0] + run[end:]
    return f"{html.escape(run[:start])}<math>{_Parser(formula).row()}</math>{html.escape(rest)}"


def _bracket(sign: str) -> str:
    return f'<mo stretchy="false">{sign}</mo>'


class _Parser:
    """A formula as MathML, from left to right."""

    def __init__(self, text: str):
        self.text, self.at = text, 0

    def row(self, until: str = "") -> str:
        """Everything up to a closing bracket, which is passed over."""
        parts = []
        while self.at < len(self.text):
            if self.text[self.at] == until:
                self.at += 1
                break
            parts.append(self.atom())
        return "".join(parts)

    def atom(self) -> str:
        """One symbol with its accents, subscripts and superscripts."""
        sign = self.text[self.at]
        self.at += 1
        if sign.isspace():
            return '<mspace width=".2em"/>'
        if sign in OPERATORS:
            return f"<mo>{html.escape(sign)}</mo>"
        if sign == "√" and self.text[self.at : self.at + 1] == "(":
            self.at += 1
            return f"<msqrt>{self.row(')')}</msqrt>"
        brackets = {"(": ")", "⟨": "⟩"}
        if sign in brackets:
            body = f"<mrow>{_bracket(sign)}{self.row(brackets[sign])}{_bracket(brackets[sign])}</mrow>"
        elif sign.isdigit() and sign not in RAISED and sign not in LOWERED:
            body = f"<mn>{sign}{self.taken('[0-9.]*[0-9]|')}</mn>"
        elif sign.isascii() and sign.isalpha():
            word = sign + self.taken("[a-z]{2,}|n(?![a-z])|") if sign.islower() else sign
            body = f"<mi>{word}</mi>" if len(word) > 1 else f"<mi>{sign}</mi>"
        else:
            body = f"<mi>{html.escape(sign)}</mi>"
        if accent := self.taken("[\u0303\u0304]|"):
            body = f'<mover accent="true">{body}<mo>{"~" if accent == chr(0x303) else "¯"}</mo></mover>'
        return self.scripts(body)

    def scripts(self, body: str) -> str:
        """The body with what stands below and above it."""
        below = above = ""
        while self.at < len(self.text):
            if found := self.taken("[₀-₉]+|"):
                below += f"<mn>{''.join(LOWERED[sign] for sign in found)}</mn>"
            elif found := self.taken("_[A-Za-zα-ω]+|"):
                below += f"<mi>{found[1:]}</mi>" if len(found) == 2 else f"<mtext>{found[1:]}</mtext>"
            elif found := self.taken("[²³]|"):
                above += f"<mn>{RAISED[found]}</mn>"
            elif found := self.taken(r"['*]|"):
                above += "<mo>′</mo>" if found == "'" else "<mo>*</mo>"
            elif self.taken(r"\^\(|"):
                above += self.row(")")
            elif self.taken(r"\^|"):
                above += (f"<mo>{minus}</mo>" if (minus := self.taken("−|")) else "") + self.atom()
            else:
                break
        if below and above:
            return f"<msubsup>{body}<mrow>{below}</mrow><mrow>{above}</mrow></msubsup>"
        if below or above:
            tag = "msub" if below else "msup"
            return f"<{tag}>{body}<mrow>{below or above}</mrow></{tag}>"
        return body

    def taken(self, pattern: str) -> str:
        """What the pattern finds here, passed over."""
        found = re.compile(pattern).match(self.text, self.at)
        self.at = found.end() if found else self.at
        return found[0] if found else ""
