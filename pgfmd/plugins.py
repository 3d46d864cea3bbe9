"""A user's own laws, solids, surfaces and observables: registered like those of the package.  No MPI, no TOML here.

A plugin is a Python file with classes as `pgfmd/README.md` describes them.  A job lists such files
(`plugins = ["my_law.py"]`), a script calls `pgfmd.register`.  Their code runs: use only files that you trust.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import sys
import traceback
import types
from dataclasses import dataclass
from typing import Any

from pgfmd.errors import InputError
from pgfmd.observables.observable import Observable
from pgfmd.observables.observable_kinds import OBSERVABLES
from pgfmd.options.section import Kinds, Section
from pgfmd.options.text import printable, show
from pgfmd.physics.laws.law import ContactLaw
from pgfmd.physics.laws.table import LAWS
from pgfmd.physics.solids.kinds import SOLIDS
from pgfmd.physics.solids.solid import Solid
from pgfmd.surfaces.rigid_surface import Surface
from pgfmd.surfaces.surface_kinds import SURFACES

TABLES: dict[type[Section], Kinds] = {ContactLaw: LAWS, Solid: SOLIDS, Surface: SURFACES}


@dataclass(frozen=True)
class Plugin:
    """A file of a user: its path and its text, which travels with the job to ranks that do not see the file."""

    path: str
    text: str

    def load(self) -> None:
        """Run the file, once for a text, and register its classes.  Raises InputError."""
        name = f"pgfmd_plugin_{hashlib.sha256(self.text.encode()).hexdigest()[:16]}"
        module = sys.modules.get(name)
        if module is None:
            module = sys.modules[name] = types.ModuleType(name)
            module.__file__ = self.path
            try:
                exec(compile(self.text, self.path, "exec"), vars(module))
            except Exception as error:
                del sys.modules[name]
                line = _line(error, self.path)
                raise InputError(f"plugins: {self.path}{line}: {type(error).__name__}: {error}") from None
        defined = [each for each in vars(module).values() if isinstance(each, type) and each.__module__ == name]
        classes: list[type] = [each for each in defined if issubclass(each, (*TABLES, Observable))]
        if not classes:
            raise InputError(f"plugins: {self.path}: defines no ContactLaw, Solid, Surface or Observable")
        register(*classes)


def read(path: str | os.PathLike) -> Plugin:
    """The plugin in a file.  Raises InputError if it cannot be read."""
    name = os.path.abspath(os.fspath(path))
    try:
        with open(name, encoding="utf-8") as file:
            return Plugin(name, file.read())
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a text in UTF-8"
        raise InputError(f"plugins: {printable(name, 400)}: cannot be read: {reason}") from None


def register(*given: type[Any] | str | os.PathLike) -> None:
    """Make classes of a law, a solid, a surface or an observable, or those of a Python file, known by their `kind` (an
    observable by its `name`), in jobs and in arguments of `solve`.

    What was registered before under the same name is replaced.  Raises InputError for a name of the package's own.

    >>> import pgfmd
    >>> from dataclasses import dataclass
    >>> from pgfmd.physics.solids.solid import Solid
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Foam(Solid):
    ...     kind = "foam"
    ...     def factor(self, q):
    ...         return 1 / (1 + 1 / q**2)
    >>> pgfmd.register(Foam)
    """
    for each in given:
        if not isinstance(each, type):
            read(each).load()
        elif issubclass(each, Observable):
            _refuse_taken(OBSERVABLES.get(each.name), each, each.name)
            OBSERVABLES[each.name] = each
        else:
            table = next((table for sort, table in TABLES.items() if issubclass(each, sort)), None)
            if table is None:
                raise InputError(f"{each.__name__}: must be a ContactLaw, Solid, Surface or Observable")
            for other in table.choices:
                _refuse_taken(other if other.kind == each.kind else None, each, each.kind)
            table.add(each)


def _refuse_taken(other: type[Section] | None, new: type[Section], name: str) -> None:
    """Raise InputError if a class of the package stands in the way, or if the class has no name or is not whole."""
    keys = [name for name, kind in inspect.get_annotations(new).items() if "ClassVar" not in str(kind)]
    if keys and "__dataclass_fields__" not in vars(new):
        raise InputError(f"{new.__name__}: has keys ({keys[0]}): put @dataclass(frozen=True, kw_only=True) above it")
    if issubclass(new, ContactLaw) and not new.methods:
        raise InputError(f'{new.__name__}: needs the solvers that take it, such as methods = ("gfmd",)')
    if not name:
        raise InputError(f"{new.__name__}: needs a kind (an observable: a name)")
    if other is not None and other is not new and other.__module__.startswith("pgfmd."):
        raise InputError(f"{new.__name__}: {show(name)} is the name of {other.__name__} in pgfmd; take another one")


def _line(error: Exception, path: str) -> str:
    """Where in the file an error was raised: ":12", or "" if that is not known."""
    if isinstance(error, SyntaxError):
        return f":{error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == path]
    return f":{lines[-1]}" if lines else ""
