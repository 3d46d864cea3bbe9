"""A smaller job that goes wrong in the same way."""

import copy
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import reference

from campaigns.random_case import Case, kind
from campaigns.running import run


def shrink(case: Case, verdict: str, detail: str, folder: Path, tries: int = 60) -> tuple[Case, str]:
    """A smaller job that goes wrong in the same way; greedy."""
    wanted, best, said = kind(verdict, detail), case, detail
    folders = (folder / f"s{number}" for number in range(10**6))

    def attempt(document, heights) -> bool:
        nonlocal best, said, tries
        if tries == 0:
            return False
        tries -= 1
        smaller = replace(best, document=document, heights=heights)
        place = next(folders)
        found = run(smaller, place)
        shutil.rmtree(place, ignore_errors=True)
        if kind(*found) == wanted:
            best, said = smaller, found[1]
            return True
        return False

    for control in reference.CONTROLS:
        targets = best.document.get("load", {}).get(control)
        for target in targets if isinstance(targets, list) and len(targets) > 1 else ():
            document = copy.deepcopy(best.document)
            document["load"][control] = [target]
            if attempt(document, best.heights):
                break
    for section in ("run", "output", "wall", "solver", "solid"):
        for name in [None, *best.document.get(section, {})]:
            document = copy.deepcopy(best.document)
            if section not in document or (name is not None and name not in document[section]):
                continue
            if name is None:
                del document[section]
                if section == "output":
                    document["output"] = {"fields": ["height", "pressure", "gap"]}
            else:
                del document[section][name]
            attempt(document, best.heights)
    while best.heights is not None and best.heights.ndim == 2 and tries:
        for axis in (0, 1):
            heights = np.delete(best.heights, -1, axis)
            document = copy.deepcopy(best.document)
            if max(heights.shape) < 2 or 0 in heights.shape or "length" in document["grid"]:
                continue
            document["grid"]["n"] = list(heights.shape)
            if attempt(document, heights):
                break
        else:
            break
    return best, said
