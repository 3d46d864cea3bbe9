# %% [markdown]
# # Contact area against load, with error bars
# Eight surfaces in one job. Several seeds are an ensemble: each has its own results, and means have standard errors.

# %%
import matplotlib.pyplot as plt
import numpy as np

import pgfmd
from pgfmd.theory import persson

job = {
    "grid": {"n": 128},
    "surface": {"kind": "self-affine", "hurst": 0.8, "lambda_s": 8.0, "rms_slope": 0.1, "seed": "1..8"},
    "solid": {"contact_modulus": 1.0},
    "load": {"pressure": [0.002, 0.005, 0.01, 0.02, 0.05]},
}

# %% Run; without a folder the results are in a temporary one
ensemble = pgfmd.run(job)
mean = ensemble.mean()
print(mean[["mean_pressure", "contact_area_corrected", "contact_area_corrected_error"]])

# %% Draw
stress = 1.0 * 0.1 / 2  # E' ḡ/2
load = np.geomspace(0.001, 0.06, 50)
plt.errorbar(mean["mean_pressure"], mean["contact_area_corrected"], mean["contact_area_corrected_error"], fmt="o",
             label="eight surfaces")  # fmt: skip
plt.plot(load, [persson.contact_fraction(p, stress) for p in load], label="Persson")
plt.xscale("log")
plt.yscale("log")
plt.xlabel("mean pressure / E'")
plt.ylabel("relative contact area")
plt.legend()
plt.show()

# %% All loads of all surfaces, as a table
print(ensemble.to_dataframe()[["mean_pressure", "kappa"]].groupby("load").describe())
