# %% [markdown]
# # A first contact
# A rough surface, pressed to a tenth of its area: where it touches, how the pressure is distributed, how sure that is.

# %%
import matplotlib.pyplot as plt
import numpy as np

import pgfmd
from pgfmd.theory import persson

rough = {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": 1}
heights = pgfmd.surface({"grid": {"n": 256}, "surface": rough})

# %% Solve: in a notebook, a bar shows the progress
contact = pgfmd.solve(heights, contact_area=0.1, contact_modulus=1.0)
print(contact)
print(f"area {contact.contact_area_corrected:.4f} ± {contact.contact_area_error:.4f}")
print(f"energy certified to {contact.certified_error:.1e}")

# %% Look
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
contact.plot(left)

# %% The distribution of pressures beside Persson's theory
histogram = contact.observables("histogram")["pressure_histogram"]
stress = 1.0 * 0.1 / 2  # E' ḡ/2, the rms stress of full contact
sigma = np.linspace(0.0, 4 * stress, 200)[1:]
right.plot(histogram["center"], contact.contact_area * histogram["density"], ".", label="simulation")
right.plot(sigma, persson.pressure_density(sigma, contact.mean_pressure, stress), label="Persson")
right.set(xlabel="pressure", ylabel="density", yscale="log", ylim=(1e-3, None))
right.legend()
plt.show()

# %% The same surface at twice and four times the load, each solved from the last if that is near
for heavier in pgfmd.solve(heights, [2 * contact.mean_pressure, 4 * contact.mean_pressure]):
    print(heavier)
