"""The type of what the formulas take and give."""

from typing import Any, TypeAlias

Reals: TypeAlias = Any
"""A float or an array; several arguments broadcast against each other."""
