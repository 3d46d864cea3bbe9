"""The surfaces that a job can ask for."""

from pgfmd.options.section import Kinds
from pgfmd.surfaces.file import FromFile
from pgfmd.surfaces.paraboloid import Cone, Paraboloid, Punch
from pgfmd.surfaces.rigid_surface import Surface
from pgfmd.surfaces.self_affine import SelfAffine
from pgfmd.surfaces.sinusoid import Sinusoid
from pgfmd.surfaces.spectrum import FromSpectrum

SURFACES = Kinds("surface", (SelfAffine, FromFile, Sinusoid, Paraboloid, Cone, Punch, FromSpectrum))
Surface.kinds = SURFACES
