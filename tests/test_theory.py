"""Theory curves against quadrature, differential equations, sampling and the integral equations that they solve."""

import pkgutil
import re

import numpy as np
import pytest
from scipy import integrate, linalg, optimize, special, stats

from pgfmd import theory
from pgfmd.errors import InputError
from pgfmd.theory import asperity, bearing, exact, exponential, hertz, persson, surface

MODULUS = 8 / 3
SURFACES = [
    surface.SelfAffineSpectrum(hurst=0.3, lambda_s=32, lambda_l=2048, rms_slope=0.031),
    surface.SelfAffineSpectrum(hurst=0.8, lambda_s=1, lambda_l=100, rms_slope=0.2, lambda_r=30),
    surface.SelfAffineSpectrum(hurst=1.0, lambda_s=2, lambda_l=100, rms_slope=0.1, lambda_r=2),
    surface.SelfAffineSpectrum(hurst=0.0, lambda_s=2, lambda_l=500, rms_slope=0.1),
]


def test_every_formula_is_reached():
    """`pgfmd.theory` gives each module of its folder, and its docstring lists them."""
    listed = re.findall(r"^- `(\w+)`", theory.__doc__, re.MULTILINE)
    assert sorted(listed) == theory.__all__ == sorted(each.name for each in pkgutil.iter_modules(theory.__path__))
    assert [getattr(theory, name).__name__ for name in listed] == [f"pgfmd.theory.{name}" for name in listed]


@pytest.mark.parametrize("model", SURFACES)
def test_moments_of_the_self_affine_spectrum(model):
    """Closed moments (logarithmic ones at H = 0 and 1 too) equal ∫ q^order C d²q by quadrature, good to 1e-10."""
    low, roll_off, high = model.q_limits
    for order in (0, 1, 2, 4):
        parts = [
            integrate.quad(lambda u, n=order: 2 * np.pi * np.exp((n + 2) * u) * model.density(np.exp(u)), *np.log(ends),
                           epsabs=0, epsrel=1e-11)[0]
            for ends in ((low, roll_off), (roll_off, high)) if ends[0] < ends[1] * (1 - 1e-12)
        ]
        assert model.moment(order) == pytest.approx(sum(parts), rel=1e-10, abs=0)
    assert model.moment(2) == pytest.approx(model.rms_slope**2, rel=1e-14, abs=0)
    q, variance = model.lines(300)
    assert np.sum(variance) == pytest.approx(model.moment(0), rel=1e-12, abs=0)
    assert np.sum(q**2 * variance) == pytest.approx(model.rms_slope**2, rel=1e-12, abs=0)


def test_moments_of_a_discrete_isotropic_spectrum():
    """m₂ = ⟨h_x²⟩ and m₄ = ⟨h_xx²⟩ of waves in all directions, derivatives taken analytically; rounding only."""
    q, power, directions = np.array([0.5, 2.0]), np.array([0.1, 0.003]), 12
    angle = 2 * np.pi * np.arange(directions) / directions
    moments = surface.SpectralMoments.from_spectrum(q, power, np.array([directions, directions]))
    along = q[:, None] * np.cos(angle)
    for order, value in ((0, moments.m0), (2, moments.m2), (4, moments.m4)):
        assert value == pytest.approx(np.sum(power[:, None] * along**order), rel=1e-13, abs=0)


@pytest.mark.parametrize(("load", "std"), [(1e-3, 1.0), (0.3, 1.0), (2.0, 0.7), (5.0, 0.4)])
def test_persson_moments_of_the_pressure(load, std):
    """∫P = f, ∫σP = p̄, ∫σ²P = ⟨σ²⟩: the closed forms and P(σ) agree by quadrature to 1e-12."""
    moments = [
        integrate.quad(lambda s, n=n: s**n * persson.pressure_density(s, load, std), 0, load + 14 * std, points=[load],
                       epsabs=0, epsrel=1e-13, limit=400)[0]
        for n in range(3)
    ]
    fraction = float(persson.contact_fraction(load, std))
    assert moments == pytest.approx([fraction, load, persson.mean_square(load, std)], rel=1e-12, abs=0)
    m2 = (moments[2] / fraction) / (moments[1] / fraction) ** 2
    assert persson.normalised_second_moment(load, std) == pytest.approx(m2, rel=1e-12, abs=0)
    above = integrate.quad(persson.pressure_density, 0.8, load + 14 * std, (load, std), points=[load], epsabs=1e-15)[0]
    assert persson.exceedance(0.8, load, std) == pytest.approx(above, rel=1e-9, abs=0)


def test_persson_pressure_diffuses_to_an_absorbing_wall():
    """∂P/∂(s²) = ½ ∂²P/∂σ² with P(0) = 0, by Crank–Nicolson from s = 0.25 to 1; its error at this step is 3e-5."""
    load, sigma = 0.8, np.linspace(0, 9, 3001)
    steps, width = 3000, sigma[1]
    density = persson.pressure_density(sigma, load, 0.25)
    pace = (1 - 0.25**2) / steps / (4 * width**2)
    bands = np.array([np.full(2999, -pace), np.full(2999, 1 + 2 * pace), np.full(2999, -pace)])
    for _ in range(steps):
        inner = density[1:-1] + pace * np.diff(density, 2)
        density[1:-1] = linalg.solve_banded((1, 1), bands, inner)
    np.testing.assert_allclose(density, persson.pressure_density(sigma, load, 1.0), atol=3e-5)


def test_persson_limits():
    """κ → √(8/π), m₂ → 4/π as p̄ → 0 (next order p̄²); full contact at high load and on a flat surface."""
    assert persson.kappa(1e-5, 1.0) == pytest.approx(np.sqrt(8 / np.pi), rel=1e-9, abs=0)
    assert persson.LOW_LOAD_KAPPA == pytest.approx(1.5958, abs=5e-5)
    assert persson.normalised_second_moment(1e-5, 1.0) == pytest.approx(4 / np.pi, rel=1e-9, abs=0)
    assert persson.contact_fraction(9.0, 1.0) == 1
    np.testing.assert_array_equal(persson.contact_fraction([0.0, 1.0], 0.0), [0, 1])
    assert persson.full_contact_std(MODULUS, 0.031) == pytest.approx(0.04133, abs=5e-6)
    fractions = np.array([1e-9, 0.02, 0.5, 0.96])
    loads = persson.load_for_area(fractions, 0.04)
    np.testing.assert_allclose(persson.contact_fraction(loads, 0.04), fractions, rtol=1e-13)


def test_persson_density_at_low_load_keeps_its_digits():
    """P(σ) → p̄ σ √(2/π) exp(−σ²/2s²)/s³ as p̄ → 0: no cancellation of the two Gaussians (next order p̄²)."""
    sigma = np.array([1e-6, 0.5, 4.0])
    expected = 1e-12 * sigma * np.sqrt(2 / np.pi) * np.exp(-(sigma**2) / 2)
    np.testing.assert_allclose(persson.pressure_density(sigma, 1e-12, 1.0), expected, rtol=1e-11)


def test_fit_recovers_the_width_of_a_sampled_distribution():
    """Brownian paths from p̄, absorbed at 0, sampled by reflection: the fit finds their s within 4 standard errors."""
    rng, load, std, count = np.random.default_rng(5), 0.4, 1.3, 400_000
    # A path that ends at σ > 0 has touched zero with probability exp(−2 p̄ σ/s²).
    free = load + std * rng.normal(size=count)
    alive = (free > 0) & (rng.random(count) > np.exp(-2 * load * np.maximum(free, 0) / std**2))
    edges = np.linspace(0, 7, 141)
    density = np.histogram(free[alive], edges)[0] / (count * np.diff(edges))
    assert persson.fit_std(edges, density, load) == pytest.approx(std, rel=4 / np.sqrt(2 * alive.sum()), abs=0)


@pytest.mark.parametrize("gamma", [1.0, 0.45])
def test_persson_energy_and_gap_are_one_thermodynamics(gamma):
    """dE/dp̄ = −p̄ dḡ/dp̄, by central differences of relative step 1e-3; E of full contact is ½⟨u K u⟩.  Errors of the
    two differences differ by step²/3 (1 − p̄E''/E'), which is 1 + p̄²/s² for E' ∝ exp(−p̄²/2s²); three times that
    leaves room for the smaller s of long waves, which weigh little."""
    q, variance = SURFACES[0].lines(500)
    std = MODULUS * SURFACES[0].rms_slope / 2
    options = dict(contact_modulus=MODULUS, gamma=gamma)
    for load in (3e-4, 0.003, 0.05, 0.2):
        energy, gap = (
            function(load * 1.001, q, variance, **options) - function(load * 0.999, q, variance, **options)
            for function in (persson.elastic_energy, persson.mean_gap)
        )
        assert energy == pytest.approx(-load * gap, rel=1e-6 * (1 + (load / std) ** 2), abs=0)
    full = np.sum(MODULUS / 4 * q * variance)
    assert persson.elastic_energy(1.0, q, variance, **options) == pytest.approx(full, rel=1e-12, abs=0)
    assert 0 <= persson.mean_gap(1.0, q, variance, **options) < 1e-12 * np.sqrt(variance.sum())


@pytest.mark.parametrize("gamma", [1.0, 0.45])
def test_persson_gap_by_quadrature(gamma):
    """The gap of one line is ∫_p̄^∞ (dE/dp)/p dp, E differentiated by hand; quadrature to 1e-9."""
    wave, power, load = 0.3, 2.0, 0.1
    std = MODULUS / 2 * np.sqrt(wave**2 * power / 2)

    def integrand(p):
        fraction = special.erf(p / (np.sqrt(2) * std))
        slope = np.sqrt(2 / np.pi) / std * np.exp(-(p**2) / (2 * std**2))
        return MODULUS / 4 * wave * power * (gamma + 3 * (1 - gamma) * fraction**2) * slope / p

    expected = integrate.quad(integrand, load, 10, epsabs=0, epsrel=1e-11)[0]
    q, variance = np.array([0.1, wave]), np.array([0.0, power])
    result = persson.mean_gap(load, q, variance, contact_modulus=MODULUS, gamma=gamma)
    assert result == pytest.approx(expected, rel=1e-9, abs=0)


def test_persson_stress_spectrum_sums_to_the_energy():
    """½ Σ |σ̃|² 2/(E'q) is the elastic energy; f at the end of a line, not its middle, is 1/2000 of ln 64 off."""
    q, variance = SURFACES[0].lines(2000)
    for load in (0.003, 0.05):
        spectrum = persson.stress_spectrum(load, q, variance, contact_modulus=MODULUS, gamma=0.45)
        energy = persson.elastic_energy(load, q, variance, contact_modulus=MODULUS, gamma=0.45)
        assert np.sum(spectrum / (MODULUS * q)) == pytest.approx(energy, rel=2e-3, abs=0)
    fraction = persson.scale_contact_fraction(0.003, q, variance, contact_modulus=MODULUS)
    assert fraction[-1] == pytest.approx(persson.contact_fraction(0.003, MODULUS * 0.031 / 2), rel=1e-12, abs=0)
    assert np.all(np.diff(fraction) <= 0)


def test_summit_statistics_by_sampling():
    """Density, curvature, mean and spread of height of summits from sampled Hessians (Kac–Rice); 4 standard errors."""
    moments = surface.SpectralMoments(m0=2.0, m2=0.5, m4=0.5)
    height, half_trace, half_difference = sampled_summits(moments, 400_000)
    weight = np.where(half_trace > half_difference, half_trace**2 - half_difference**2, 0) / (2 * np.pi * moments.m2)
    assert np.mean(weight) == pytest.approx(moments.summit_density, abs=4 * np.std(weight) / np.sqrt(len(weight)))
    for sample, mean in ((half_trace, moments.summit_curvature), (height, moments.summit_height)):
        error = np.std(weight * (sample - mean)) / np.sqrt(len(weight)) / np.mean(weight)
        assert np.average(sample, weights=weight) == pytest.approx(mean, abs=4 * error)
    square = (height - moments.summit_height) ** 2
    variance = moments.summit_height_std**2
    error = np.std(weight * (square - variance)) / np.sqrt(len(weight)) / np.mean(weight)
    assert np.average(square, weights=weight) == pytest.approx(variance, abs=4 * error)


def sampled_summits(moments, count):
    """Heights, and half trace and half difference of eigenvalues of minus the Hessian, of a Gaussian surface."""
    m0, m2, m4 = moments.m0, moments.m2, moments.m4
    covariance = [[m0, -m2, -m2, 0], [-m2, m4, m4 / 3, 0], [-m2, m4 / 3, m4, 0], [0, 0, 0, m4 / 3]]
    h, hxx, hyy, hxy = np.random.default_rng(11).multivariate_normal(np.zeros(4), covariance, count).T
    return h, -(hxx + hyy) / 2, np.hypot((hxx - hyy) / 2, hxy)


@pytest.mark.parametrize(("alpha", "separation"), [(2.0, 0.5), (6.0, 1.0), (30.0, 0.0)])
def test_bush_gibson_thomas_by_sampling(alpha, separation):
    """Sampled summits, each an elliptic Hertz contact solved for its ellipticity; 4 standard errors.  Johnson's
    equations, p₀ the peak pressure, e the eccentricity, a > b: κ₁/κ₂ = [(a/b)²E − K]/(K − E), κ₁ + κ₂ = 2(p₀/E') E/b, δ
    = (p₀/E') b K; area π a b, load (2/3) p₀ π a b."""
    moments = surface.SpectralMoments(1.0, 1.0, alpha)
    height, trace, difference = sampled_summits(moments, 600_000)
    touching = (trace > difference) & (height > separation)
    depth, trace, difference = height[touching] - separation, trace[touching], difference[touching]
    weight = (trace**2 - difference**2) / (2 * np.pi * moments.m2)
    axes = np.linspace(1e-3, 1, 20001)[:-1]  # b/a
    first, second = special.ellipk(1 - axes**2), special.ellipe(1 - axes**2)
    curvatures = (second / axes**2 - first) / (first - second)
    ratio = (trace + difference) / np.maximum(trace - difference, 1e-12)
    shape = np.interp(np.log(ratio), np.log(curvatures[::-1]), axes[::-1], right=1e-3)
    first, second = special.ellipk(1 - shape**2), special.ellipe(1 - shape**2)
    minor = np.sqrt(depth * second / (first * trace))
    area = weight * np.pi * minor**2 / shape
    load = area * 2 / 3 * MODULUS * trace * minor / second
    result = asperity.bush_gibson_thomas(separation, moments, MODULUS)
    for value, terms in zip(result, (area, load), strict=True):
        error = np.sqrt(np.sum(terms**2)) / 600_000
        assert value == pytest.approx(np.sum(terms) / 600_000, abs=4 * error)
        assert error < 0.015 * value


@pytest.mark.parametrize("alpha", [1.5, 2.0, 10.0])
def test_bush_gibson_thomas_tends_to_proportionality(alpha):
    """κ → √(2π) for any bandwidth, corrections in α/d²: Richardson from d = 15 and 30 rms heights, error d^−4."""
    moments = surface.SpectralMoments(1.0, 1.0, alpha)
    area, pressure = asperity.bush_gibson_thomas(np.array([15.0, 30.0]), moments, MODULUS)
    near, far = area * MODULUS * moments.rms_slope / pressure
    assert abs(far / asperity.LOW_LOAD_KAPPA_BGT - 1) < 0.3 * alpha / 30**2
    assert (4 * far - near) / 3 == pytest.approx(np.sqrt(2 * np.pi), rel=4 * alpha**2 / 15**4, abs=0)


def test_bush_gibson_thomas_quadrature():
    """Midpoint sums of Nayak's density over height, mean curvature and axis ratio k give the same integrals.  The share
    of the curvatures between two k comes from differences of Johnson's equations: no derivative and no factor is shared
    with the package.  Midpoint error of these steps below 1e-6."""
    moments, separation = surface.SpectralMoments(1.0, 1.0, 3.0), 1.0
    k = (np.arange(4001)[1:] / 4000) ** 2
    first, second = special.ellipk(1 - k[:-1] ** 2), special.ellipe(1 - k[:-1] ** 2)
    curvatures = (second / k[:-1] ** 2 - first) / (first - second)
    ratio = np.append((curvatures - 1) / (curvatures + 1), 0)  # r/t from κ₁/κ₂; a sphere at k = 1
    middle, share = (ratio[1:] + ratio[:-1]) / 2, -np.diff(ratio)
    axis = np.sqrt((k[1:] ** 2 + k[:-1] ** 2) / 2)
    first, second = special.ellipk(1 - axis**2), special.ellipe(1 - axis**2)
    t = (np.arange(400) + 0.5)[:, None] * 0.03
    shape = t**4 * middle * np.exp(-((middle * t) ** 2) / 2) * (1 - middle**2) * share / (2 * np.pi)
    root = (np.arange(2000) + 0.5) * 0.0015
    normal = stats.multivariate_normal([0, 0], [[1, 1], [1, 2]])  # m₀, m₂, 2m₄/3
    weight = normal.pdf(np.stack(np.broadcast_arrays(separation + root**2, t), axis=-1)) * 2 * root * 0.0015 * 0.03
    minor = np.sqrt(second / (first * t))  # at unit penetration
    area = np.sum(np.sum(shape * np.pi * minor**2 / axis, axis=1) * (weight @ root**2))
    load = np.sum(np.sum(shape * 2 / 3 * np.pi * minor**3 / axis * t / second, axis=1) * (weight @ root**3))
    assert asperity.bush_gibson_thomas(separation, moments, 1.0) == pytest.approx((area, load), rel=3e-6, abs=0)


def test_greenwood_williamson_by_quadrature():
    """Area and load of Hertzian summits with Gaussian heights, ∫ over the height distribution; quadrature to 1e-9."""
    moments = surface.SpectralMoments(1.0, 0.3, 0.5)
    radius, spread = 1 / moments.summit_curvature, moments.summit_height_std
    for separation in (-1.0, 0.0, 2.5):
        def total(function, d=separation):
            heights = stats.norm(moments.summit_height, spread)
            return integrate.quad(lambda z: function(z - d) * heights.pdf(z), d, d + 20, epsabs=0, epsrel=1e-11)[0]

        area = moments.summit_density * total(lambda depth: np.pi * radius * depth)
        load = moments.summit_density * total(lambda depth: 4 / 3 * MODULUS * np.sqrt(radius) * depth**1.5)
        result = asperity.greenwood_williamson(separation, moments, MODULUS)
        assert result == pytest.approx((area, load), rel=1e-9, abs=0)


@pytest.mark.parametrize("model", [asperity.greenwood_williamson, asperity.bush_gibson_thomas])
def test_asperity_model_at_a_given_pressure(model):
    """`at_pressure` inverts the model to the tolerance of the root finder; out of range is an input error."""
    moments = SURFACES[0].moments()
    pressures = np.array([[1e-6, 1e-3], [3e-3, 1e-2]])
    area, separation = asperity.at_pressure(model, pressures, moments, MODULUS)
    again = model(separation, moments, MODULUS)
    np.testing.assert_allclose(again[0], area, rtol=1e-12)
    np.testing.assert_allclose(again[1], pressures, rtol=1e-9)
    with pytest.raises(InputError, match="range"):
        asperity.at_pressure(model, 1e9, moments, MODULUS)


def test_impossible_surfaces_are_refused():
    """Nayak's parameter below 3/2, cut-offs out of order, no slope: input errors that name the quantity."""
    with pytest.raises(InputError, match="Nayak"):
        asperity.bush_gibson_thomas(1.0, surface.SpectralMoments(1.0, 1.0, 1.4), 1.0)
    for change in ({"lambda_s": 100}, {"lambda_r": 200}, {"rms_slope": 0}):
        with pytest.raises(InputError, match=list(change)[0]):
            surface.SelfAffineSpectrum(**{"hurst": 0.5, "lambda_s": 1, "lambda_l": 100, "rms_slope": 0.1, **change})


@pytest.mark.parametrize("fraction", [0.003, 0.3, 0.5, 0.9])
def test_bearing_autocorrelation_is_the_orthant_probability(fraction):
    """P(X > t, Y > t) of a Gaussian pair by one-dimensional quadrature of the conditional probability, to 1e-10."""
    level = bearing.threshold(fraction, 1.0)
    assert bearing.area(level, 1.0) == pytest.approx(fraction, rel=1e-13, abs=0)
    for rho in (-0.9, -0.2, 0.0, 0.5, 0.99):
        def integrand(x, rho=rho):
            return stats.norm.pdf(x) * special.ndtr((rho * x - level) / np.sqrt(1 - rho**2))

        expected = integrate.quad(integrand, level, 12, points=[max(level, 0.0)], epsabs=1e-14)[0]
        assert bearing.autocorrelation(rho, fraction) == pytest.approx(expected, abs=1e-12)
    assert bearing.autocorrelation(1.0, fraction) == pytest.approx(fraction, rel=1e-13, abs=0)
    assert bearing.autocorrelation(-1.0, fraction) == pytest.approx(max(2 * fraction - 1, 0), abs=1e-13)


def test_bearing_exponent_follows_from_the_height_correlation():
    """With 1 − ρ = r^{2H}/2 the contact correlation falls as r^H for r → 0, whose transform is q^−(2+H)."""
    for hurst in (0.3, 0.8):
        r = np.array([1e-6, 1e-5])
        drop = 0.2 - bearing.autocorrelation(1 - r ** (2 * hurst) / 2, 0.2)
        assert 2 + np.log10(drop[1] / drop[0]) == pytest.approx(bearing.spectrum_exponent(hurst), abs=1e-2)
    assert bearing.patch_exponent(0.8) == pytest.approx(1.6)


def test_exponential_wall_response_is_two_springs_in_series():
    """A mode sees the wall p̄/ζ and the solid E'q/2 in series: σ̃ = h̃/(1/wall + 1/solid); ζ → 0 is full contact."""
    q, power, load, zeta = np.array([0.01, 0.3, 2.0]), np.array([3.0, 0.2, 0.01]), 0.004, 0.25
    series = 1 / (zeta / load + 2 / (MODULUS * q))
    result = exponential.stress_spectrum(q, power, load, zeta, contact_modulus=MODULUS)
    np.testing.assert_allclose(result, series**2 * power, rtol=1e-13)
    full = persson.full_contact_spectrum(q, power, contact_modulus=MODULUS)
    np.testing.assert_allclose(
        exponential.stress_spectrum(q, power, load, 0.0, contact_modulus=MODULUS), full, rtol=1e-15
    )


def test_hertz_solves_the_half_space_equations():
    """u(0) = (1/πE')∫p/r d²r is the approach, ∫p the load, ½∫p u the energy (u = δ − r²/2R); quadrature 1e-9."""
    load, tip = 0.7, 30.0
    radius, peak, approach = hertz.contact(load, tip, contact_modulus=MODULUS)

    def over_disc(function):
        return integrate.quad(lambda s: 2 * np.pi * function(s) * hertz.pressure(s, radius, peak), 0, radius)[0]

    assert over_disc(lambda s: s) == pytest.approx(load, rel=1e-9, abs=0)
    assert over_disc(lambda s: 1.0) / (np.pi * MODULUS) == pytest.approx(approach, rel=1e-9, abs=0)
    energy = over_disc(lambda s: s * (approach - s**2 / (2 * tip)) / 2)
    assert hertz.elastic_energy(load, tip, contact_modulus=MODULUS) == pytest.approx(energy, rel=1e-9, abs=0)
    assert hertz.radius_from_second_moment(over_disc(lambda s: s**3) / load) == pytest.approx(radius, rel=1e-9, abs=0)
    area = hertz.patch_area(8 * load, tip, contact_modulus=MODULUS)
    assert area == pytest.approx(4 * np.pi * radius**2, rel=1e-12, abs=0)


def test_lattice_sums():
    """Σ'|n|^−1 and Σ'|n|^−3 by Ewald's splitting, which converges like exp(−π n²), to 1e-13."""
    i, j = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    x = np.pi * (i**2 + j**2)[(i != 0) | (j != 0)]
    half = special.gammaincc(0.5, x) * special.gamma(0.5)  # Γ(1/2, x)
    gammas = {0.5: half, 1.5: half / 2 + np.sqrt(x) * np.exp(-x), -0.5: 2 * (np.exp(-x) / np.sqrt(x) - half)}
    for s, expected in ((0.5, hertz.LATTICE_SUM_1), (1.5, hertz.LATTICE_SUM_3)):
        total = np.sum(gammas[s] * x**-s + gammas[1 - s] * x ** (s - 1)) - 1 / s - 1 / (1 - s)
        assert np.pi**s / special.gamma(s) * total == pytest.approx(expected, rel=1e-13, abs=0)


@pytest.mark.parametrize("ratio", [0.05, 0.1, 0.15])
def test_periodic_hertz_minimises_the_energy(ratio):
    """Of all Hertzian pressures of one load the one of least complementary energy on the cell has this radius.  The
    energy ½⟨p u⟩ − ⟨p h⟩ is a sum over modes, with p̃ = 2π p₀ a² (sin x − x cos x)/x³, x = q a.  At the minimum contact
    is even, u = δ − r²/2R, which gives the approach.  The true pressure leaves Hertz's form by the fifth power of a/L;
    cutting the sum at q a = 600 adds (q a)^−3 < 1e-8."""
    tip, free_radius = 40.0, 2.5
    cell = free_radius / ratio
    load = 4 * MODULUS * free_radius**3 / (3 * tip)
    index = np.arange(int(100 / ratio) + 1)
    squares, weights = np.unique(np.add.outer(index**2, index**2), return_inverse=True)
    modes = np.where(index == 0, 1, 2)
    weights = np.bincount(weights.ravel(), np.outer(modes, modes).ravel())[1:]
    q = 2 * np.pi / cell * np.sqrt(squares[1:])

    def interaction(radius):  # ∫ p u over the cell
        x = q * radius
        pressure = 3 * load * (np.sin(x) - x * np.cos(x)) / x**3
        return np.sum(weights * 2 / (MODULUS * q) * pressure**2) / cell**2

    best = optimize.minimize_scalar(
        lambda radius: interaction(radius) / 2 + load * radius**2 / (5 * tip),
        bracket=(0.9 * free_radius, 1.1 * free_radius), tol=1e-9,
    ).x
    result = hertz.periodic_contact(load, tip, cell, contact_modulus=MODULUS)
    assert result.radius / free_radius == pytest.approx(best / free_radius, abs=ratio**5 + 1e-6)
    approach = interaction(best) / load + best**2 / (5 * tip)
    assert result.approach / approach == pytest.approx(1, abs=ratio**5 + 1e-6)
    # The load (2/3) p₀ π a² is P up to the square of the cubic correction.
    assert 2 / 3 * np.pi * result.radius**2 * result.peak_pressure == pytest.approx(load, rel=3 * ratio**6, abs=0)


@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.95])
def test_westergaard_solves_its_integral_equation(fraction):
    """u = −(2/πE')∫p ln|2 sin(π(x−x')/λ)|dx' + c touches h in contact and clears it outside; mean gap c, energy ½⟨p u⟩.
    x' = (λ/π) asin(sin(πc/λ) sin θ) makes p dx' smooth; the logarithm is split at x' = x; quadrature to 1e-9."""
    amplitude, wavelength = 0.3, 7.0
    case = exact.Westergaard(amplitude, wavelength, MODULUS)
    load = fraction * case.full_pressure
    edge = np.sin(np.pi * case.half_width(load) / wavelength)

    def place(theta):
        return wavelength / np.pi * np.arcsin(edge * np.sin(theta))

    def density(theta):  # p dx/dθ
        phase = np.pi * place(theta) / wavelength
        return case.pressure(place(theta), load) * wavelength / np.pi * edge * np.cos(theta) / np.cos(phase)

    def displacement(x):
        theta = np.arcsin(np.clip(np.sin(np.pi * x / wavelength) / edge, -1, 1))

        def integrand(t):
            return -density(t) * np.log(np.abs(2 * np.sin(np.pi * (x - place(t)) / wavelength)))

        ends = [-np.pi / 2, theta, np.pi / 2]
        parts = [integrate.quad(integrand, a, b, limit=200)[0] for a, b in zip(ends, ends[1:], strict=False) if a < b]
        return 2 / (np.pi * MODULUS) * sum(parts)

    def height(x):
        return amplitude * np.cos(2 * np.pi * x / wavelength)

    assert integrate.quad(density, -np.pi / 2, np.pi / 2)[0] == pytest.approx(load * wavelength, rel=1e-10, abs=0)
    gap = case.mean_gap(load)
    half_width = case.half_width(load)
    for x in np.array([0.0, 0.4, 0.9]) * half_width:
        assert displacement(x) - height(x) + gap == pytest.approx(0, abs=1e-8 * amplitude)
    for x in half_width + np.array([0.2, 0.9]) * (wavelength / 2 - half_width):
        assert displacement(x) - height(x) + gap > 1e-4 * amplitude
    # In contact u = h − c, and the mean of u is zero.
    energy = integrate.quad(lambda t: density(t) * (height(place(t)) - gap) / 2, -np.pi / 2, np.pi / 2)[0] / wavelength
    assert case.elastic_energy(load) == pytest.approx(energy, rel=1e-9, abs=0)


def test_westergaard_full_contact():
    """At and above p* the contact is full: pressure p̄ + p* cos, no gap, energy p*Δ/4; the two branches meet at p*."""
    case = exact.Westergaard(0.3, 7.0, MODULUS)
    x = np.linspace(0, 7, 15)
    full = case.full_pressure
    np.testing.assert_allclose(case.pressure(x, full * (1 - 1e-14)), case.pressure(x, full), atol=1e-6 * full)
    np.testing.assert_allclose(case.pressure(x, 2 * full), full * (2 + np.cos(2 * np.pi * x / 7)), rtol=1e-13)
    assert case.mean_gap(2 * full) == 0
    assert case.contact_area(2 * full) == 1
    assert case.elastic_energy(2 * full) == pytest.approx(full * 0.3 / 4, rel=1e-14, abs=0)
    np.testing.assert_array_equal(case.pressure(x, 0.0), 0)
    assert (case.mean_gap(0.0), case.elastic_energy(0.0)) == (0.3, 0)


def test_sinusoid_table_joins_its_asymptotes():
    """f = 0.01 lies 3 % above the limit of low load, f = 0.9 within 0.002 of that of high load.  p* is the amplitude of
    the full-contact pressure of the mode |q| = 2√2π/λ."""
    case = exact.Sinusoid2D(0.2, 9.0, MODULUS)
    table = exact.SINUSOID_2D_TABLE
    assert case.full_pressure == pytest.approx(MODULUS / 2 * np.sqrt(2) * 2 * np.pi / 9 * 0.2, rel=1e-14, abs=0)
    assert table["area"][0] / case.low_load_area(0.01 * case.full_pressure) == pytest.approx(1.03, abs=0.01)
    assert table["area"][-1] == pytest.approx(case.high_load_area(0.9 * case.full_pressure), abs=2e-3)
    # Two Hertz contacts of tip radius 1/(Δ(2π/λ)²) on each cell λ², each carrying p̄ λ²/2.
    load = 1e-4 * case.full_pressure
    patch = hertz.patch_area(load * 81 / 2, 1 / (0.2 * (2 * np.pi / 9) ** 2), contact_modulus=MODULUS)
    assert case.low_load_area(load) == pytest.approx(2 * patch / 81, rel=1e-12, abs=0)


def test_strip_punch_presses_flat():
    """−(2/πE')∫p ln|2 sin(π(x−x')/λ)|dx' is the approach at every x under the punch; quadrature to 1e-8."""
    case, load = exact.StripPunch(1.1, 5.0, MODULUS), 0.02
    edge = np.sin(np.pi * 1.1 / 5)

    def place(theta):
        return 5 / np.pi * np.arcsin(edge * np.sin(theta))

    # p dx = p̄ (λ/π) dθ under x = place(θ): checked on the profile itself
    theta = np.array([-1.2, 0.1, 0.8])
    slope = 5 / np.pi * edge * np.cos(theta) / np.cos(np.pi * place(theta) / 5)
    np.testing.assert_allclose(case.pressure(place(theta), load) * slope, load * 5 / np.pi, rtol=1e-12)
    for at in theta:
        def integrand(t, at=at):
            return -np.log(np.abs(2 * np.sin(np.pi * (place(at) - place(t)) / 5)))

        parts = sum(integrate.quad(integrand, *ends, limit=200)[0] for ends in ((-np.pi / 2, at), (at, np.pi / 2)))
        assert 2 / (np.pi * MODULUS) * load * 5 / np.pi * parts == pytest.approx(case.approach(load), rel=1e-8, abs=0)
    np.testing.assert_array_equal(case.pressure([1.2, 2.5, -1.2, 5 - 1.2], load), 0)
