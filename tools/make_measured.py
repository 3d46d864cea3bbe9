"""Makes the heights of jobs/measured.toml: a surface as an instrument delivers it, tilted, in metres.

    python tools/make_measured.py [FOLDER]

writes measured.sdf (ISO 25178-71, binary: what many instruments export) and the same heights as measured.npy.  128 × 96
points 0.1 µm × 0.12 µm apart, 36 nm rms about a plane that is tilted by 3 and −2 mrad; like any patch that is cut
out of a larger surface it does not close upon itself.
"""

import argparse
import struct
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).resolve().parent.parent / "jobs" / "data"
SHAPE, SPACING = (128, 96), (0.1e-6, 0.12e-6)  # points; metres
TILT, SLOPE, HURST, SHORTEST = (3e-3, -2e-3), 0.05, 0.8, 0.8e-6


def heights() -> np.ndarray:
    """Heights (nx, ny) in metres, float32: a corner of a self-affine surface twice as large, tilted."""
    noise = np.random.default_rng(2008).normal(size=(2 * SHAPE[0], 2 * SHAPE[1]))
    q = np.hypot(*np.meshgrid(*map(_frequencies, noise.shape, SPACING), indexing="ij"))
    inside = (q > 0) & (q <= 2 * np.pi / SHORTEST)
    modes = np.fft.fft2(noise) * np.where(inside, q, np.inf) ** (-1.0 - HURST) / noise.size
    rough = np.fft.ifft2(modes, norm="forward").real[: SHAPE[0], : SHAPE[1]]
    rough *= SLOPE / np.sqrt(np.sum(q**2 * np.abs(modes) ** 2))
    x, y = np.ogrid[: SHAPE[0], : SHAPE[1]]
    plane = TILT[0] * SPACING[0] * x + TILT[1] * SPACING[1] * y
    return (rough + plane).astype(np.float32)


def sdf(values: np.ndarray) -> bytes:
    """The heights (nx, ny), metres, as a binary file of ISO 25178-71: 81 bytes of header, then lines along x."""
    floats = 3
    header = struct.pack(
        "<8s10s12s12sHHdddd3b", b"bISO-1.0", b"synthetic", b"010120080000",
        b"010120080000", *values.shape, *SPACING, 1.0, 0.0, 0, floats, 0,
    )  # fmt: skip
    return header + values.T.astype("<f4").tobytes()


def _frequencies(count: int, spacing: float) -> np.ndarray:
    return 2 * np.pi * np.fft.fftfreq(count, spacing)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    values = heights()
    np.save(folder / "measured.npy", values)
    (folder / "measured.sdf").write_bytes(sdf(values))


if __name__ == "__main__":
    main()
