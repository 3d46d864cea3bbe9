"""Random jobs over all keys, walls, solids, controls and units."""

import copy
import math

import numpy as np

from campaigns.random_case import Case

LARGEST_SIDE = 24


def draw(seed: int, number: int, extension: str = "", ranks: int = 1) -> Case:
    """The job of that number; the same whatever was drawn before.  extension: one of `EXTENSIONS` that it must have;
    ranks: how many rows it has at least.
    """
    chance = np.random.default_rng([seed, number])
    shape = [max(_side(chance), ranks), _side(chance)]
    if max(shape) < 2:
        shape[chance.integers(2)] = 2
    if chance.random() < 0.4:
        shape[1] = shape[0] = max(shape)
    length_unit, modulus = 10.0 ** _exponent(chance), 10.0 ** _exponent(chance)
    spacing = length_unit * np.ones(2)
    if chance.random() < 0.3:
        spacing = spacing * 10 ** chance.uniform(-1, 1, 2)
    document = {"grid": _grid(chance, shape, spacing), "solid": _solid(chance, modulus, shape, spacing)}
    steepness = 10 ** (chance.uniform(-3, 1) if chance.random() < 0.9 else chance.uniform(-60, 60))
    size = float(steepness * min(spacing))  # typical height between neighbours
    surface, heights = _surface(chance, shape, spacing, size, steepness)
    document["surface"] = surface
    if heights is not None and heights.size:
        with np.errstate(all="ignore"):
            size = float(np.std(heights) or size)
    stress = modulus * size / float(min(spacing))
    law = _wall(chance, size, stress)
    if law:
        document["wall"] = law
    document["load"] = _load(chance, stress, size, shape, law)
    document["solver"] = _solver(chance, law)
    document["output"] = _output(chance, shape, spacing)
    if chance.random() < 0.2:
        document["run"] = {"checkpoint_interval": [0.0, math.inf, 60.0][chance.integers(3)]}
    factor = None
    if chance.random() < 0.5 or extension:
        factor = _extend(chance, document, size, modulus, spacing, extension)
    for name in [name for name, table in document.items() if not table]:
        del document[name]
    spoilt = bool(chance.random() < 0.12)
    if spoilt:
        spoil(chance, document)
    way = chance.choice(["solve", "simulate", "command"], p=[0.35, 0.645, 0.005])
    if way == "solve" and not _solvable(document, spoilt):
        way = "simulate"
    return Case(number, document, heights, str(way), spoilt, factor)


def _side(chance) -> int:
    return int(chance.integers(*((1, 9), (9, 17), (17, LARGEST_SIDE + 1))[chance.choice(3, p=[0.6, 0.3, 0.1])]))


def _exponent(chance) -> float:
    """Of a unit: often none, often that of SI, at times absurd."""
    return float(chance.choice([0.0, chance.uniform(-12, 12), chance.uniform(-100, 100)], p=[0.4, 0.4, 0.2]))


def _grid(chance, shape, spacing) -> dict:
    table = {"n": shape[0] if shape[0] == shape[1] and chance.random() < 0.5 else shape}
    if chance.integers(2):
        return table | {"length": [float(n * value) for n, value in zip(shape, spacing, strict=True)]}
    return table | {"spacing": [float(value) for value in spacing]}


def _solid(chance, modulus: float, shape, spacing) -> dict:
    poisson = float(chance.choice([chance.uniform(-0.9, 0.49), 0.25, 0.0, 0.4999], p=[0.5, 0.3, 0.1, 0.1]))
    way, mu = chance.integers(4), modulus * (1 - poisson) / 2
    table = (
        {"contact_modulus": modulus, "poisson": poisson},
        {"young": modulus * (1 - poisson**2), "poisson": poisson},
        {"lame_lambda": 2 * mu * poisson / (1 - 2 * poisson), "lame_mu": mu},
        {"contact_modulus": modulus},
    )[way]
    if chance.random() < 0.4:
        cell = float(max(n * value for n, value in zip(shape, spacing, strict=True)))
        power = chance.uniform(-3, 1.5) if chance.random() < 0.8 else chance.uniform(-20, 20)
        table["thickness"] = cell * 10**power
        table["base"] = str(chance.choice(["bonded", "free", "sliding"]))
        if "poisson" not in table and way == 3 and chance.random() < 0.8:
            table["poisson"] = poisson
    return table


def _surface(chance, shape, spacing, size: float, steepness: float) -> tuple[dict, np.ndarray | None]:
    kind = chance.choice(["file", "self-affine", "sinusoid", "paraboloid"], p=[0.45, 0.3, 0.15, 0.1])
    if kind == "self-affine":
        longest = max(n * value for n, value in zip(shape, spacing, strict=True)) / min(spacing)
        table = {"kind": "self-affine", "hurst": float(chance.uniform(0, 1))}
        table["lambda_s"] = float(chance.choice([1.0, min(2.0, longest), chance.uniform(0.5, longest)]))
        table["rms_slope"] = float(steepness)
        if chance.random() < 0.5:
            table["seed"] = int(chance.integers(0, 2**63 - 1))
        if chance.random() < 0.2:
            table["lambda_l"] = float(chance.uniform(table["lambda_s"], longest))
            if chance.random() < 0.5:
                table["lambda_r"] = float(chance.choice([longest, math.inf]))
        return table, None
    if kind == "sinusoid":
        table = {"kind": "sinusoid", "amplitude": float(size * chance.choice([1, -1]))}
        if chance.random() < 0.5:
            table["waves"] = int(chance.integers(1, max(2, min(shape) // 2 + 1)))
        if chance.random() < 0.5:
            table["two_dimensional"] = bool(chance.random() < 0.7)
        return table, None
    if kind == "paraboloid":
        return {"kind": "paraboloid", "radius": float(min(spacing) / steepness)}, None
    table = {"kind": "file", "path": "heights.npy"}
    heights = draw_heights(chance, shape) * size
    if chance.random() < 0.15:
        table["detrend"] = str(chance.choice(["none", "mean", "plane"]))
    if chance.random() < 0.1:
        table["periodic"] = str(chance.choice(["as-is", "taper"]))
    if chance.random() < 0.15:
        table["height_scale"] = float(chance.choice([-1.0, 2.0, 1e-3]))
    return table, heights


def draw_heights(chance, shape) -> np.ndarray:
    """An odd surface of heights of order 1."""
    noise = chance.standard_normal(shape)
    way = chance.integers(10)
    if way in (2, 5):  # spikes that differ in their last digits; flat, but for a hole or nothing
        flat = np.zeros(shape)
        for _ in range(int(chance.integers(1, 5)) if way == 2 else 1):
            value = 1 + 10.0 ** -chance.integers(1, 17) if way == 2 else -chance.integers(2)
            flat[chance.integers(shape[0]), chance.integers(shape[1])] = value
        return flat
    odd = {
        0: lambda: np.round(noise),  # plateaus
        1: lambda: (noise > 0.7).astype(float),  # pillars
        3: lambda: noise + 10 ** chance.uniform(0, 9),  # far from zero
        4: lambda: noise * 10 ** chance.uniform(-8, 0, shape),  # heights of all sizes
        6: lambda: np.repeat(np.sign(chance.standard_normal((shape[0], 1))), shape[1], 1),  # a step
        7: lambda: noise.astype(np.float32).astype(float),  # single precision
    }
    return odd.get(int(way), lambda: noise)()


def _wall(chance, size: float, stress: float) -> dict:
    kind = chance.choice(["", "hard", "hardness", "exponential"], p=[0.5, 0.1, 0.1, 0.3])
    if kind in ("", "hard"):
        return {"kind": "hard"} if kind else {}
    if kind == "hardness":
        return {"kind": "hardness", "hardness": float(stress * 10 ** chance.uniform(-2, 2))}
    tail = chance.random() < 0.1
    table = {"kind": "exponential", "zeta": size * 10 ** (chance.uniform(-100, 100) if tail else chance.uniform(-4, 3))}
    if chance.random() < 0.3:
        table["sigma_ref"] = 10.0 ** float(chance.uniform(-30, 30))
    return table


def _load(chance, stress: float, size: float, shape, wall: dict) -> dict:
    control = str(chance.choice(["pressure", "contact_area", "mean_gap", "displacement"], p=[0.55, 0.15, 0.15, 0.15]))
    count = int(chance.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))
    targets = []
    for _ in range(count):
        way = chance.random()
        if control == "pressure":
            powers = ((-3, 0.7), (-14, 3), (-100, 20))[0 if way < 0.6 else 1 if way < 0.85 else 2]
            value = stress * 10 ** chance.uniform(*powers)
            if way > 0.97:
                value = float(chance.choice([0.0, 1e-300, 1e300, 1e-100 * stress]))
        elif control == "contact_area":
            value = chance.uniform(0, 1) if way < 0.7 else 10 ** chance.uniform(-6, 0)
            if way > 0.9:
                value = chance.integers(1, shape[0] * shape[1] + 1) / (shape[0] * shape[1]) * (1 - 1e-3)
        else:
            value = size * (chance.uniform(0.01, 3) if way < 0.7 else 10 ** chance.uniform(-8, 1))
            if way > 0.9:
                value *= -1 if chance.random() < 0.5 else 10 ** chance.uniform(0, 40)
        targets.append(float(value))
    if wall.get("kind") == "hardness":  # others are refused
        targets.sort(reverse=control == "mean_gap")
    table = {control: targets[0] if count == 1 and chance.random() < 0.5 else targets}
    if chance.random() < 0.15:
        name = "area_tolerance" if control == "contact_area" else "gap_tolerance"
        table[name] = 10.0 ** float(chance.uniform(-8, -0.5))
    return table


def _solver(chance, wall: dict) -> dict:
    table = {}
    way = chance.random()
    if way > 0.4:
        table["tolerance"] = 10.0 ** float(chance.uniform(-12, -1) if way < 0.9 else chance.uniform(-17, -12))
    way = chance.random()
    if way > 0.7:
        own = "newton" if wall.get("kind") == "exponential" else "active-set"
        table["method"] = str(chance.choice(["auto", own, "gfmd"], p=[0.3, 0.4, 0.3]))
        if table["method"] == "gfmd" and chance.random() < 0.8:
            table["max_iterations"] = int(10 ** chance.uniform(0, 3.5))
    return table


EXTENSIONS = ("open", "layered", "table", "attracts", "formula", "second", "refined", "closes", "follows", "seeds",
              "shape")  # fmt: skip


def _extend(chance, document: dict, size: float, modulus: float, spacing, extension: str) -> np.ndarray | None:
    """Change a job in place: a kind that few jobs have, and often what follows from its contact.  Returns the table of
    a file: q and F(q) of a solid, or C(q) of a surface.
    """
    way = extension or str(chance.choice(EXTENSIONS, p=[0.15, 0.1, 0.1, 0.15, 0.15, 0.05, 0.05, 0.05, 0.1, 0.05, 0.05]))
    step, factor = float(min(spacing)), None
    if way == "open":
        document["grid"]["boundary"] = "open"
        if "pressure" in document["load"] and chance.random() < 0.3:
            document["load"]["force"] = document["load"].pop("pressure")
        if chance.random() < 0.2:
            document["solid"] = _layer(chance, modulus, step)
    elif way == "layered":
        document["solid"] = _layer(chance, modulus, step)
    elif way == "table":
        document["solid"] = {"kind": "table", "contact_modulus": modulus, "path": "factor.npy"}
        first = 10 ** chance.uniform(-2, 1) / step
        factor = np.array([[first, 10 ** chance.uniform(-2, 2)],
                           [first * 10 ** chance.uniform(0.1, 2), 10 ** chance.uniform(-2, 2)]])  # fmt: skip
    elif way == "attracts":
        _attract(chance, document, size * 10 ** float(chance.uniform(-1, 1.5)), modulus, step)
    elif way == "formula":
        document["wall"] = _formula(chance, size, modulus * size / step)
        document["solver"].pop("method", None)
    elif way == "second":
        document["surface"]["second"] = {"kind": "sinusoid", "amplitude": size * float(chance.uniform(-2, 2))}
    elif way == "refined":
        document["grid"]["refine"] = int(chance.integers(1, 4))
    elif way == "closes":
        document["load"] = {"percolation": "gap"}
        if chance.random() < 0.5:
            document["load"]["percolation_accuracy"] = 10.0 ** float(chance.uniform(-4, -0.5))
    elif way == "seeds" and document["surface"]["kind"] == "self-affine":
        document["surface"]["seed"] = [int(seed) for seed in chance.integers(0, 1000, 2)]
    elif way == "shape":
        document["surface"] = _shape(chance, size, step)
        if document["surface"]["kind"] == "spectrum":
            most = (size * step) * (size * step)
            factor = np.array([[0.1 / step, most], [6 / step, most * chance.uniform(0, 1)]])
    if way == "follows" or chance.random() < 0.3:
        wall = document.get("wall", {}).get("kind", "hard")
        unfit = {
            "adhesion": wall not in ("adhesive", "dugdale", "potential"),
            "closing_load": "percolation" not in document["load"],
            "partial_slip": wall != "hard",
            "subsurface": bool({"thickness", "kind"} & set(document["solid"])),
        }
        fit = [name for name in FOLLOWS if not unfit.get(name) or chance.random() < 0.1]
        document["output"]["observables"] = [str(name) for name in chance.permutation(fit)[: chance.integers(1, 5)]]
        _options(chance, document, size, step)
        if not {"kind", "lame_mu"} & set(document["solid"]):
            document["solid"].setdefault("poisson", 0.25)
    return factor


def _shape(chance, size: float, step: float) -> dict:
    """The table of a cone, a punch, or a surface of which the spectrum is a file."""
    kind, radius = str(chance.choice(["cone", "punch", "spectrum"])), step * 10 ** float(chance.uniform(-1, 1))
    if kind == "cone":
        return {"kind": kind, "slope": size / step}
    if kind == "spectrum":
        return {"kind": kind, "path": "factor.npy", "seed": int(chance.integers(0, 1000))}
    table = {"kind": kind, "radius": radius, "depth": size, "shape": str(chance.choice(["round", "square"]))}
    if chance.random() < 0.5:
        table["edge"] = radius * 10 ** float(chance.uniform(-2, 2))
    if chance.random() < 0.5:
        table["tilt"] = [float(size / step * value) for value in chance.normal(0, 0.1, 2)]
    return table


def _options(chance, document: dict, size: float, step: float) -> None:
    """Of the observables that a job asks for, and the fields that they write; at times of a file and of transforms."""
    output, half = document["output"], {"half_grid": bool(chance.random() < 0.5)}
    share = {"load_share": float(chance.uniform(0, 1))} if chance.random() < 0.5 else {"shift": size}
    options = {
        "partial_slip": {"friction": 10 ** float(chance.uniform(-2, 1))} | share,
        "stiffness": {"width": 10 ** float(chance.uniform(-9, -0.5)), "conductivities": [1.0, 30.0]} | half,
        "leakage": {"width": 10 ** float(chance.uniform(-9, -0.5)), "direction": str(chance.choice(["both", "x", "y"]))}
        | half,
        "subsurface": {"depths": [step * 10 ** float(chance.uniform(-2, 2))] * int(chance.random() < 0.8)},
        "gap_spectrum": {"bins": int(chance.integers(1, 60)), "all_modes": bool(chance.random() < 0.5)},
    }
    fields = {"partial_slip": ["traction"], "leakage": ["flux_x", "flux_y"], "stiffness": ["current_density"],
              "subsurface": ["von_mises"]}  # fmt: skip
    for name in sorted(set(options) & set(output["observables"])):
        if name == "partial_slip" or chance.random() < 0.7:
            output[name] = options[name]
        if chance.random() < 0.3:
            output["fields"] = output["fields"] + fields.get(name, [])
    if document["surface"]["kind"] == "file" and chance.random() < 0.3:
        more = ({"first_axis": "y"}, {"periodic": "mirror"}, {"detrend": "quadratic"})[chance.integers(3)]
        document["surface"] |= more
        if "detrend" not in more:
            document["grid"].pop("n")  # which is that of the file, or twice that
    if chance.random() < 0.1:
        document["solver"]["transform"] = "mpi4py-fft"
    if chance.random() < 0.05:
        document["solver"]["storage"] = "float32"


def _layer(chance, modulus: float, step: float) -> dict:
    """The table of a layered solid."""
    return {
        "kind": "layered", "contact_modulus": modulus, "poisson": float(chance.uniform(-0.5, 0.49)),
        "thickness": step * 10 ** float(chance.uniform(-2, 2)),
        "base_modulus": modulus * 10 ** float(chance.uniform(-4, 4)), "base_poisson": float(chance.uniform(-0.5, 0.49)),
    }  # fmt: skip


def _attract(chance, document: dict, reach: float, modulus: float, step: float) -> None:
    """A wall that attracts within a reach, and how its branch is followed."""
    process_zone = step * 10 ** float(chance.uniform(-0.3, 1.5))  # ρ²E'/w
    kind, tension = str(chance.choice(["adhesive", "dugdale", "potential"])), modulus * reach / process_zone
    document["wall"] = {"kind": kind, "range": reach, "work": tension * reach}
    if kind == "dugdale" and chance.random() < 0.3:
        document["wall"]["edge"] = float(chance.uniform(0, 2))
    if kind == "potential":
        scaled = f"(gap / {reach!r} - 1)"
        document["wall"] = {"kind": kind, "pressure": f"{4 * tension!r} * (exp(-2 * {scaled}) - exp(-{scaled}))",
                            "gaps": [0.3 * reach, 15.0 * reach]}  # fmt: skip
    if chance.random() < 0.3:
        document["load"]["cycle"] = True
    if chance.random() < 0.2:
        document["load"]["branch"] = str(chance.choice(["cold", "probe"]))
    document["solver"].pop("method", None)


def _formula(chance, size: float, stress: float) -> dict:
    """The table of a wall that is a formula of the gap."""
    reach, most = size * 10 ** float(chance.uniform(-1.5, 1)), stress * 10 ** float(chance.uniform(-1.5, 1.5))
    scaled = f"(gap / {reach!r})"
    written, least, last = (
        (f"exp(-{scaled})", chance.uniform(-5, 5), 30.0),
        (f"{scaled}**-{chance.integers(1, 10)}", 0.3, 30.0),
        (f"max(1 - {scaled}, 0)", 0.0, float(chance.uniform(0.5, 2))),
        (f"erfc({scaled})", -1.0, 10.0),
        (f"1 / (1 + {scaled}**2)", 0.0, 5.0),
    )[chance.integers(5)]
    return {"kind": "formula", "pressure": f"{most!r} * {written}", "gaps": [float(least * reach), last * reach]}


FOLLOWS = ("stiffness", "percolation", "leakage", "partial_slip", "subsurface", "discretisation", "gap_spectrum",
           "gap_slope", "pressure_skewness", "adhesion", "closing_load")  # fmt: skip
OBSERVABLES = ("histogram", "spectra", "acf", "patches", "bearing", "lowpass")


def _output(chance, shape, spacing) -> dict:
    table = {"fields": ["height", "pressure", "gap"] + ["displacement", "labels"] * int(chance.random() < 0.15)}
    if chance.random() < 0.05:
        table["precision"] = "float32"
    if chance.random() < 0.25:
        table["observables"] = [str(name) for name in chance.permutation(OBSERVABLES)[: chance.integers(0, 7)]]
        for name in ("spectra", "acf"):
            if chance.random() < 0.3:
                table[name] = {"spacing": str(chance.choice(["log", "linear"])), "bins": int(chance.integers(1, 60))}
        if chance.random() < 0.3:
            table["histogram"] = {"bins": int(chance.integers(1, 300))}
        if chance.random() < 0.3:
            table["patches"] = {"connectivity": int(chance.choice([4, 8]))}
        if chance.random() < 0.3:
            cell = max(n * value for n, value in zip(shape, spacing, strict=True))
            table["lowpass"] = {"q": [float(2 * np.pi / cell * 10 ** chance.uniform(-1, 2))]}
    return table


NASTY = (
    math.nan, math.inf, -math.inf, -1.0, 0.0, -0.0, 1e-300, 1e300, 5e-324, 1, -1, 0, True, False, "", "x", "\u202e", [],
    [1.0, 2.0, 3.0], [[1.0]], {}, {"a": 1}, 2**40, -(2**70), 2**64, 1.5, "hard", "exponential", "gfmd", "nan",
)  # fmt: skip


def spoil(chance, document: dict) -> None:
    """Change a job in place: a value replaced, a key lost, doubled or misspelt."""
    for _ in range(int(chance.integers(1, 3))):
        section = str(chance.choice(sorted(document)))
        table = document[section]
        if not isinstance(table, dict) or not table:
            continue
        name = str(chance.choice(sorted(table)))
        way = chance.integers(6)
        if way <= 3:
            table[name] = copy.deepcopy(NASTY[chance.integers(len(NASTY))])
        elif way == 4:
            del table[name]
        else:
            table[name + "x"] = table.pop(name)
    try:  # too large to be tried on a small machine, too small to be refused
        points = np.prod(np.atleast_1d(document["grid"]["n"]).astype(float))
        if 1e5 < points < 1e15:
            document["grid"]["n"] = 4
    except (KeyError, TypeError, ValueError):
        pass


def _solvable(document: dict, spoilt: bool) -> bool:
    """Whether `pgfmd.solve` knows all that the job says."""
    load, wall = document.get("load"), document.get("wall", {})
    return (
        not spoilt
        and "kind" not in document["solid"]
        and not set(document["grid"]) & {"boundary", "refine"}
        and wall.get("kind") not in ("adhesive", "dugdale", "potential")
        and document["surface"].get("kind") == "file"
        and not set(document["surface"]) & {"detrend", "periodic", "height_scale", "second"}
        and isinstance(load.get("pressure"), float)
        and "sigma_ref" not in wall
        and "contact_modulus" in document["solid"]
    )
