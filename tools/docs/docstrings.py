"""Docstrings are plain text with examples: as Markdown, with nothing taken for a link, examples as code, and a table of
the parameters of a function, or of the fields of a class, with what the text says after their names ("spacing: …").
"""

import re

import griffe

NAME = r"[a-z_]+(?: \([^()]*\))?"
ABOUT = re.compile(rf"(?:^|(?<=[.;)])\s+)({NAME}(?:,\s+{NAME})*):\s+")  # name: …, or name, other ("a" if None): …
END = re.compile(r"\s+(?=(?:Raises|Returns) )")


class Tables(griffe.Extension):
    """Changes the docstring of every object that mkdocstrings reads."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Called by griffe."""
        if obj.docstring is None:
            return
        fields = obj.parameters if obj.is_function else obj.attributes.values() if obj.is_class else ()
        known = {field.name: field for field in fields if field.name not in ("self", "cls") and field.annotation}
        said: dict[str, str] = {}
        paragraphs = re.split(r"\n\s*\n", obj.docstring.value)
        obj.docstring.value = "\n\n".join([markdown(taken(part, known, said)) for part in paragraphs])
        if said:
            about = {name: markdown(said.get(name, "see above")) for name in known}
            rows = (f"| `{name}` | {shown(field)} | {about[name]} |" for name, field in known.items())
            obj.docstring.value += "\n\n" + "\n".join(["| name | type, default | |", "|---|---|---|", *rows])


def taken(paragraph: str, known: dict, said: dict[str, str]) -> str:
    """The paragraph without what it says of known names, which goes into `said`."""
    if paragraph.lstrip().startswith(">>>"):
        return paragraph
    left, names = "", None
    for number, text in enumerate(ABOUT.split(paragraph)):
        if number % 2:
            names = re.split(r",\s+", re.sub(r" \([^()]*\)", "", text))
            prefix = ""
            if not set(names) <= set(known):
                names, prefix = None, text + ": "
        elif names is None:
            left += f" {prefix if number else ''}{text}"
        else:
            about, *rest = END.split(text, maxsplit=1)
            said |= dict.fromkeys(names, " ".join(about.split()).rstrip(";"))
            left, names = " ".join([left, *rest]), None
    return left.strip()


def shown(field) -> str:
    """Type and default of a parameter or a field."""
    default = getattr(field, "default", None)
    return f"`{field.annotation}`" + ("" if default is None else f" = `{default}`")


def markdown(paragraph: str) -> str:
    """A paragraph of a docstring."""
    if paragraph.startswith(">>>"):
        return f"```python\n{paragraph}\n```"
    return re.sub(r"([\[\]*<>|])", r"\\\1", paragraph)
