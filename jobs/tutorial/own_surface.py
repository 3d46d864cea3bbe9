"""Heights of your own, here a grooved plate, as an array: pressed until a fifth of it touches."""

import numpy as np

import pgfmd

x = np.arange(256) * 100 / 256  # µm
grooves = 0.5 * np.cos(2 * np.pi * x / 25)[:, None] + 0.01 * np.random.default_rng(1).normal(size=(256, 256))
contact = pgfmd.solve(grooves, contact_area=0.2, contact_modulus=3000 / (1 - 0.4**2), spacing=100 / 256)
print(contact)
np.save("grooves.npy", grooves)  # and a file that a job may name: surface.path = "grooves.npy"
