"""Random jobs against the slow reference, the quick version of tools/bench/campaign.py; and the judge itself."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
from conftest import SIZE, broad

pytest.importorskip("mpi4py")
if np.finfo(np.longdouble).eps > 1e-18:
    pytest.skip("the reference needs extended precision", allow_module_level=True)

from campaigns import random_case as cases  # noqa: E402
from campaigns import running, walls  # noqa: E402
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
@pytest.mark.parametrize("count", broad([30, 300]))
def test_random_jobs(comm, shared_tmp_path, count):
    """Each is right, to its certified error, or refused in one line.  A third are right at least: 62 per cent of 11,600
    were, and fewer than a third of 30 then has a probability of 4e-4.  On ranks fifteen are run, of which one at most
    is right with a probability of 1e-5.  Number 203 is the first in single precision that is solved."""
    if SIZE > 1:
        if count > 30:
            pytest.skip("takes too long")
        count = 15
    bad, verdicts = bad_ones(comm, shared_tmp_path, sorted({*range(count), 203}))
    assert not bad, f"{verdicts}\n" + "\n".join(bad[:3])
    assert verdicts[cases.RIGHT] > (count / 3 if SIZE == 1 else 1)


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


@pytest.mark.parametrize(("spoil", "said"), [
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
])  # fmt: skip
def test_the_judge_sees_what_is_wrong(tmp_path, monkeypatch, spoil, said):
    """An answer that is spoilt on purpose is called wrong; a sound one is not."""
    heights = np.random.default_rng(1).standard_normal((6, 5))
    case = cases.Case(0, SOUND | {"solver": {"tolerance": 1e-10}}, heights, "simulate")
    judge = running.judge

    def spoilt(job, heights, answers, *more):
        spoil(answers[0])
        return judge(job, heights, answers, *more)

    monkeypatch.setattr(running, "judge", spoilt)
    verdict, detail = running.run(case, tmp_path / "case")
    assert verdict == (cases.WRONG if said else cases.RIGHT), detail
    assert any(words in detail for words in said.split("|"))


WALLS = {
    "formula": {"kind": "formula", "pressure": "exp(-(gap / 0.3))", "gaps": [0.0, 9.0]},
    "adhesive": {"kind": "adhesive", "range": 1.5, "work": 0.3},
    "potential": {"kind": "potential", "pressure": "0.2 * (exp(-4 * (gap - 1)) - exp(-2 * (gap - 1)))",
                  "gaps": [0.3, 10.0]},
}  # fmt: skip


def test_the_judge_finds_the_largest_tension():
    """That of Morse's potential is a quarter of its prefactor."""
    assert walls.tension(WALLS["potential"]) == pytest.approx(0.05, rel=1e-14)


@pytest.mark.parametrize("kind", WALLS)
def test_the_judge_knows_other_walls(tmp_path, monkeypatch, kind):
    """Contacts under a formula and under attraction are in equilibrium; a field or number that is spoilt is seen."""
    heights = 0.1 * np.random.default_rng(1).standard_normal((6, 5))
    case, given, judge = cases.Case(0, SOUND | {"wall": WALLS[kind]}, heights, "simulate"), [], running.judge
    monkeypatch.setattr(running, "judge", lambda *everything: given.append(everything) or judge(*everything))
    assert running.run(case, tmp_path / "case") == (cases.RIGHT, "")
    job, heights, (answer,), factor = given[0]
    for name, spoil in {
        "pressure": answer.pressure * (1 + 0.01 * np.sign(answer.pressure - answer.pressure.mean())),
        "gap": answer.gap + 0.01 * np.cos(np.arange(5)), "mean_gap": answer.mean_gap + 0.01,
        "elastic_energy": answer.elastic_energy * 1.01,
    }.items():  # fmt: skip
        assert judge(job, heights, [dataclasses.replace(answer, **{name: spoil})], factor)[0] == cases.WRONG, name


@pytest.mark.mpi
def test_ranks_are_compared_with_one(comm, shared_tmp_path, monkeypatch):
    """A job is right beside one rank; a field, a column or a dataset of a group that depends on the ranks is seen."""
    if comm.size == 1:
        pytest.skip("needs several ranks")
    document = SOUND | {"output": SOUND["output"] | {"observables": ["spectra", "leakage"]}}
    case = cases.Case(0, document, np.random.default_rng(1).standard_normal((6, 5)), "simulate")
    assert running.run_beside_one(case, shared_tmp_path / "sound", comm) == (cases.RIGHT, "")
    answered = running.answered
    for number, spoil in enumerate((
        lambda answer: answer.columns.__setitem__("kappa", answer.columns["kappa"] * 1.01),
        lambda answer: answer.groups["stress_spectrum"]["value"].__imul__(1.01),
        lambda answer: answer.pressure.__imul__(1.01),
    )):  # fmt: skip

        def spoilt(case, folder, comm=None, spoil=spoil):
            found = answered(case, folder, comm)
            if comm is not None and comm.rank == 0:
                spoil(found[2][0])
            return found

        monkeypatch.setattr(running, "answered", spoilt)
        verdict, detail = running.run_beside_one(case, shared_tmp_path / str(number), comm)
        assert comm.bcast(verdict) == cases.WRONG, detail


def rough(hurst: float, slope: float, seed: int, **more: float) -> dict:
    """The table of a self-affine surface."""
    return {"kind": "self-affine", "hurst": hurst, "lambda_s": 1.0, "rms_slope": slope, "seed": seed} | more


HALF = {"contact_modulus": 1.0}
FOUND_BY_CAMPAIGNS = {
    "a modulus that is the least number": {
        "grid": {"n": 7}, "solid": {"contact_modulus": 5e-324}, "surface": rough(0.76, 0.0765739364019711, 1),
        "load": {"pressure": 15568.7},
    },
    "a soft wall, a heavy load, open": {
        "grid": {"n": [17, 16], "boundary": "open"}, "solid": HALF, "surface": rough(0.3, 5e-33, 7854332287662991715),
        "wall": {"kind": "exponential", "zeta": 6.043e-37}, "load": {"mean_gap": 2.624e-36},
        "solver": {"tolerance": 1.09e-10},
    },
    "a film as a liquid": {
        "grid": {"n": 7, "spacing": [0.2387636503890919, 0.4709840817514992]},
        "solid": HALF | {"poisson": 0.4999, "thickness": 4.4057173468161424e-18, "base": "sliding"},
        "surface": rough(0.319185211752563, 0.002317585289745214, 1022811265018411863, lambda_l=7.285363625157576),
        "load": {"mean_gap": [0.0015272516339104457, 0.00021695200264617618]},
        "solver": {"tolerance": 1.1688575661821066e-15},
    },
    "slopes that the grid does not see": {
        "grid": {"n": [2, 8], "boundary": "open"}, "surface": {"kind": "file", "path": "heights.npy"},
        "solid": HALF | {"poisson": 0.4999, "thickness": 0.42, "base": "sliding"}, "load": {"pressure": 1e-3},
    },
    "slip where all touches": {
        "grid": {"n": 8}, "surface": {"kind": "sinusoid", "amplitude": 1e-3}, "solid": HALF | {"poisson": 0.3},
        "load": {"pressure": 1.0},
        "output": SOUND["output"] | {"observables": ["partial_slip"], "partial_slip": {"friction": 0.5}},
    },
    "the stiffness of a wall of tiny range": {
        "grid": {"n": [6, 4], "length": [1.8901656578909457e-33, 1.2601104385939638e-33]},
        "solid": HALF | {"poisson": 0.25},
        "surface": {"kind": "sinusoid", "amplitude": -4.06e-35, "waves": 2, "two_dimensional": True},
        "wall": {"kind": "exponential", "zeta": 1.970661518295288e-36},
        "load": {"pressure": [0.016843519572954314, 2.386841736747255e-08], "gap_tolerance": 0.00067},
        "solver": {"tolerance": 3.857e-16}, "output": SOUND["output"] | {"observables": ["stiffness"]},
    },
    "lengths that single precision does not hold, open": {
        "grid": {"n": [2, 8], "length": [1.1e-84, 1.1e-84], "boundary": "open"},
        "surface": {"kind": "sinusoid", "amplitude": 4e-85}, "solid": {"contact_modulus": 6.3e94},
        "load": {"pressure": 6.57e68}, "solver": {"tolerance": 2.4e-05},
    },
    "a way down that underflows": {
        "grid": {"n": 12}, "surface": {"kind": "sinusoid", "amplitude": 0.7277213803827509},
        "solid": {"contact_modulus": 5.414983659961245e-07, "thickness": 0.15294774977309505, "base": "free",
                  "poisson": -0.3280153177319338},
        "wall": {"kind": "adhesive", "range": 1.7140714139557645, "work": 1.888470451510505e-07},
        "load": {"mean_gap": [1.229665009296971, 1.2811472679665914, 0.01970366060821797]},
        "solver": {"tolerance": 4.802640813005076e-12},
    },
    "a response that single precision does not hold, open": {
        "grid": {"n": 23, "length": [1.0371894400447691e22, 1.0371894400447691e22], "boundary": "open"},
        "surface": rough(0.8178688094154262, 0.007454706037356808, 1), "load": {"displacement": 9.816e52},
        "solid": {"lame_lambda": 1.13, "lame_mu": 0.303, "thickness": 387679525.3},
    },
    "attraction that has ended": {
        "grid": {"n": [15, 2], "spacing": [578202.7462119024, 578202.7462119024]}, "solid": {"contact_modulus": 1.0},
        "surface": {"kind": "sinusoid", "amplitude": 18509.10147762364, "two_dimensional": True},
        "wall": {"kind": "dugdale", "range": 2389.1836154813072, "work": 2.2130949900382757},
        "load": {"mean_gap": 50072.67957950608, "gap_tolerance": 3.847e-06},
    },
    "energies whose square overflows": {
        "grid": {"n": [4, 3], "length": [6.794271133419311e83, 5.095703350064483e83]},
        "solid": {"contact_modulus": 3.602393312973145e86, "poisson": -0.55}, "surface": rough(0.92, 0.0523, 6),
        "load": {"contact_area": 0.24975}, "output": SOUND["output"] | {"observables": ["discretisation"]},
    },
    "a small energy far above": {
        "grid": {"n": [3, 3]}, "surface": {"kind": "paraboloid", "radius": 392.0}, "solid": HALF | {"poisson": 0.25},
        "wall": {"kind": "dugdale", "range": 4.389e-4, "work": 6.548e-8}, "load": {"pressure": [0.00158, 4.1e-27]},
    },
    "a wall that is stiffer than its digits show": {
        "grid": {"n": 9, "length": [2199688959185.3877, 13165463683312.625]},
        "solid": {"young": 28995938612.492085, "poisson": -0.8301761418682192},
        "surface": {"kind": "sinusoid", "amplitude": 10388741087.728472},
        "wall": {"kind": "formula", "pressure": "84729429316.31598 * max(1 - (gap / 14050595925.956856), 0)",
                 "gaps": [0.0, 27071200612.245667]},
        "load": {"pressure": 6.439006421469625e-09},
    },
    "a far distance over the tiniest": {
        "grid": {"n": [8, 19], "spacing": [1.3404498261980936e-05, 1.3404498261980936e-05]},
        "solid": {"lame_lambda": 0.750538003313868, "lame_mu": 0.3256487553726511},
        "surface": {"kind": "paraboloid", "radius": 0.002207948136557974},
        "wall": {
            "kind": "potential", "gaps": [5.841398328794074e-08, 2.920699164397037e-06],
            "pressure": "0.003025145097957382 * (exp(-2 * (gap / 1.9471327762646914e-07 - 1))"
            " - exp(-(gap / 1.9471327762646914e-07 - 1)))",
        },
        "load": {"pressure": [1.040298839022228e-53, 2761675248223919.0, 0.0009117643579223804]},
    },
    "a flow without neighbours": {
        "grid": {"n": [2, 1]}, "surface": {"kind": "sinusoid", "amplitude": 2.0295e-3}, "solid": HALF,
        "load": {"contact_area": 0.1289}, "output": SOUND["output"] | {"observables": ["leakage"]},
    },
    "a search from no load": {
        "grid": {"n": [1, 2], "boundary": "open"}, "surface": {"kind": "file", "path": "heights.npy"}, "solid": HALF,
        "load": {"displacement": 1e23},
    },
}  # fmt: skip


SLOW = "a wall that is stiffer than its digits show"  # 9 s, half of all


@pytest.mark.parametrize("name", broad(sorted(FOUND_BY_CAMPAIGNS, key=SLOW.__eq__), len(FOUND_BY_CAMPAIGNS) - 1))
def test_what_campaigns_found_stays_mended(tmp_path, name):
    """No traceback, no warning, no wrong number: an answer, or one line."""
    document = {"output": SOUND["output"]} | FOUND_BY_CAMPAIGNS[name]
    shape = document["grid"]["n"]
    heights = np.full((2, 8), 0.006) * [[1], [-1]] if shape == [2, 8] else np.zeros((1, 2))
    case = cases.Case(0, document, heights if "path" in document["surface"] else None, "simulate")
    verdict, detail = running.run(case, tmp_path / "case")
    assert verdict not in cases.BAD, detail


@pytest.mark.parametrize("kind", ["layered", "table"])
def test_the_judge_knows_other_solids(tmp_path, monkeypatch, kind):
    """A contact on a layer, and on a table of F(q), is right by the slow reference, whose F is its own."""
    solid = {"kind": kind, "contact_modulus": 1.0}
    if kind == "layered":
        solid |= {"poisson": 0.3, "thickness": 0.7, "base_modulus": 30.0, "base_poisson": 0.1}
    else:
        solid["path"] = "factor.npy"
    heights = np.random.default_rng(1).standard_normal((6, 5))
    factor = np.array([[0.5, 0.2], [2.0, 3.0]]) if kind == "table" else None
    case, given, judge = cases.Case(0, SOUND | {"solid": solid}, heights, "simulate", factor=factor), [], running.judge
    monkeypatch.setattr(running, "judge", lambda *everything: given.append(everything) or judge(*everything))
    assert running.run(case, tmp_path / "case") == (cases.RIGHT, "")
    job, heights, answers, factor = given[0]
    if kind == "table":
        factor = factor * [[1, 1], [1, 1.02]]
    else:
        job["solid"]["base_modulus"] = 29.0
    assert judge(job, heights, answers, factor)[0] == cases.WRONG


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
