"""The arguments of `solve` and `certify`, checked one by one; raises InputError in one line for each that is wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from pgfmd.errors import InputError
from pgfmd.grid.domain import DOMAINS
from pgfmd.options.rules import Rule, checked, choice, number, pair
from pgfmd.options.section import Kinds, Section, build
from pgfmd.options.text import printable, show
from pgfmd.parallel.mpi import MPI
from pgfmd.solvers.options import Load
from pgfmd.surfaces.measurement import is_topography, measured_heights

BOUNDARY = choice(*DOMAINS)
SPACING = pair(number(low=1e-150, high=1e150))  # so that their squares neither overflow nor underflow


def surface_of(given: Any, spacing: Any, comm: MPI.Comm) -> tuple[np.ndarray, Any]:
    """Heights, sharing no memory that others may write, and spacing of an array or topography; raises InputError."""
    values, spacing = measured_heights(given, spacing, comm)
    heights = real_numbers("heights", values)
    if heights.ndim != 2 or heights.size == 0:
        raise InputError(f"heights of shape {heights.shape}: must be two-dimensional and not empty")
    if not np.isfinite(heights).all() and not is_topography(given):
        at = ", ".join(map(str, np.argwhere(~np.isfinite(heights))[0]))
        raise InputError(f"heights: [{at}] is {heights[~np.isfinite(heights)][0]}; all must be finite")
    return own_copy(heights, values), spacing


def alike(name: str, values: Any, heights: np.ndarray) -> np.ndarray:
    """An array of real numbers of the heights' shape; raises InputError."""
    array = real_numbers(name, values)
    if array.shape != heights.shape:
        raise InputError(f"{name} of shape {array.shape}: must be that of the heights, {heights.shape}")
    return array


def own_copy(array: np.ndarray, given: Any) -> np.ndarray:
    """The array, or a copy if it shares the memory of the given one, and somebody may write there."""
    owner = array
    while isinstance(owner.base, np.ndarray) and not owner.flags.writeable:
        owner = owner.base
    return array.copy() if owner.flags.writeable and np.may_share_memory(array, given) else array


def real_numbers(name: str, values: Any) -> np.ndarray:
    """An array of real numbers in float64, row by row; raises InputError for anything else."""
    if np.ma.is_masked(values):
        raise InputError(f"{name}: {np.ma.count_masked(values)} values are masked; fill them")
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"not {array.dtype}")
        return np.ascontiguousarray(array, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: must be an array of real numbers: {printable(str(error), 100)}") from None


def targets_of(imposed: Mapping[str, Any]) -> tuple[str, tuple[float, ...], bool]:
    """The name of what is imposed, its values, and whether it was given as a number.  Raises InputError."""
    given = [name for name, value in imposed.items() if value is not None]
    if len(given) != 1:
        raise InputError(f"give exactly one of {', '.join(imposed)}; found {' and '.join(given) or 'none'}")
    value = imposed[given[0]]
    values = list(value) if isinstance(value, range) else value
    single = not isinstance(values, (list, tuple)) and np.ndim(values) == 0
    return given[0], checked(given[0], values, rule_of_load("pressure" if given[0] == "force" else given[0])), single


@cache
def rule_of_load(name: str) -> Rule:
    """The rule of a key of [load]."""
    return {field.name: field.metadata["rule"] for field in dataclasses.fields(Load)}[name]


def section_of(kinds: Kinds, sort: type[Section], given: object) -> Any:
    """What was given as an object of that sort, or as a table of its keys; raises InputError."""
    made = build(kinds, dict(given)) if isinstance(given, Mapping) else given
    if not isinstance(made, sort):
        raise InputError(f"{kinds.where} = {show(given)}: must be a {sort.__name__}, or a table of its keys")
    return made


def agree(comm: MPI.Comm, asked: tuple) -> None:
    """Raises InputError if the ranks were called with different arguments.  Collective."""
    if any(other != asked for other in comm.allgather(asked)):
        raise InputError("the ranks ask for different contacts: all arguments but heights and start must be the same")
