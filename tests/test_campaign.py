"""Random jobs against the slow reference, the quick version of tools/bench/campaign.py; and the judge itself."""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np
import pytest
from conftest import ROOT, SIZE, broad

pytest.importorskip("mpi4py")
if np.finfo(np.longdouble).eps > 1e-18:
    pytest.skip("the reference needs extended precision", allow_module_level=True)
sys.path.insert(0, str(ROOT / "tools" / "bench"))

from campaigns import random_case as cases  # noqa: E402
from campaigns import running  # noqa: E402
from campaigns.drawing import draw  # noqa: E402
from campaigns.shrinking import shrink  # noqa: E402

SEED = 15


def bad_ones(comm, folder, numbers) -> tuple[list[str], Counter]:
    """What goes wrong in jobs of SEED on the ranks of comm, and how many end how.  Collective."""
    bad, verdicts = [], Counter()
    for number in numbers:
        case = draw(SEED, number)
        case.way = "simulate" if case.way == "command" else case.way
        verdict, detail = comm.bcast(running.run(case, folder / str(number), comm))
        verdicts[verdict] += 1
        if verdict in cases.BAD:
            bad.append(cases.show(case, f"{verdict}: {detail}"))
    return bad, verdicts


@pytest.mark.mpi
@pytest.mark.parametrize("count", broad([40, 300]))
def test_random_jobs(comm, shared_tmp_path, count):
    """Each is right, to its certified error, or refused in one line.  A third are right at least: 62 per cent
    of 11,600 were, and fewer than a third of 40 then has a probability of 1e-4.
    """
    if SIZE > 1 and count > 40:
        pytest.skip("takes too long")
    bad, verdicts = bad_ones(comm, shared_tmp_path, range(count))
    assert not bad, f"{verdicts}\n" + "\n".join(bad[:3])
    assert verdicts[cases.RIGHT] > count / 3


def test_a_job_is_the_same_whatever_was_drawn_before():
    """Its number and the seed make it."""
    draw(SEED, 3)
    one, two = draw(SEED, 7), draw(SEED, 7)
    assert cases.toml(one.document) == cases.toml(two.document) != cases.toml(draw(1, 7).document)


SOUND = {
    "grid": {"n": [6, 5]},
    "surface": {"kind": "file", "path": "heights.npy"},
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.2]},
    "output": {"fields": ["height", "pressure", "gap"]},
}


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda answer: None, ""),
        (lambda answer: answer.pressure.__imul__(1.01), "load is not carried"),
        (lambda answer: answer.pressure.__setitem__((0, 0), np.nan), "not finite"),
        (lambda answer: answer.gap.__iadd__(1.0), "gap in contact"),
        (lambda answer: answer.gap.__imul__(1.0 + 1e-2), "gap off"),
        (lambda answer: setattr(answer, "mean_gap", answer.mean_gap * 1.01), "mean gap off"),
        (lambda answer: setattr(answer, "elastic_energy", answer.elastic_energy * 1.01), "elastic energy"),
        (lambda answer: setattr(answer, "certified_error", -1e-20), "certified"),
        (lambda answer: setattr(answer, "certified_error", 1.0), "certified"),
        (lambda answer: setattr(answer, "contact_area", 0.5), "contact area"),
        (lambda answer: setattr(answer, "mean_pressure", answer.mean_pressure * (1 + 1e-14)), "mean pressure"),
        (lambda answer: answer.pressure.__setitem__(..., answer.pressure[::-1].copy()), "gap in contact|true error"),
    ],
)
@pytest.mark.skipif(SIZE > 1, reason="once is enough")
def test_the_judge_sees_what_is_wrong(tmp_path, monkeypatch, spoil, said):
    """An answer that is spoilt on purpose is called wrong; a sound one is not."""
    heights = np.random.default_rng(1).standard_normal((6, 5))
    case = cases.Case(0, SOUND | {"solver": {"tolerance": 1e-10}}, heights, "simulate")
    judge = running.judge

    def spoilt(job, heights, answers):
        spoil(answers[0])
        return judge(job, heights, answers)

    monkeypatch.setattr(running, "judge", spoilt)
    verdict, detail = running.run(case, tmp_path / "case")
    assert verdict == (cases.WRONG if said else cases.RIGHT), detail
    assert any(words in detail for words in said.split("|"))


@pytest.mark.skipif(SIZE > 1, reason="once is enough")
def test_a_minimal_job_is_found(tmp_path, monkeypatch):
    """Of a job of many keys that goes wrong through one of them, little more than that one is left."""
    document = SOUND | {
        "wall": {"kind": "exponential", "zeta": 0.3, "sigma_ref": 2.0},
        "solver": {"tolerance": 1e-5, "method": "newton"},
        "run": {"checkpoint_interval": 0.0},
        "load": {"pressure": [0.2, 0.3]},
    }
    heights = np.random.default_rng(1).standard_normal((6, 5))
    monkeypatch.setattr(
        running, "judge", lambda job, *_: ("wrong", "ζ") if job["wall"].get("zeta") == 0.3 else ("right", "")
    )
    case = cases.Case(0, document, heights, "simulate")
    small, said = shrink(case, *running.run(case, tmp_path / "case"), tmp_path)
    assert said == "ζ" and small.document["wall"]["zeta"] == 0.3 and "sigma_ref" not in small.document["wall"]
    assert not {"solver", "run"} & set(small.document) and small.document["load"] == {"pressure": [0.2]}
    assert small.document["solid"] == {"contact_modulus": 1.0}  # it has no default
    assert small.heights.size < heights.size
