"""pgfmd for Spack: `spack repo add` a repository that holds this file as packages/py-pgfmd/package.py."""

from spack.package import PythonPackage, depends_on, license, variant, version


class PyPgfmd(PythonPackage):
    """Elastic contact of randomly rough surfaces, solved in parallel."""

    pypi = "pgfmd/pgfmd-0.1.0.tar.gz"
    license("MIT")
    version("0.1.0")

    variant("mpi", default=True, description="several ranks")
    variant("plot", default=True, description="figures")

    depends_on("python@3.11:", type=("build", "run"))
    depends_on("py-setuptools@77:", type="build")
    depends_on("py-numpy@1.26:", type=("build", "run"))
    depends_on("py-scipy@1.11:", type=("build", "run"))
    depends_on("py-h5py@3.10:", type=("build", "run"))
    depends_on("py-numba@0.59:0.68", type=("build", "run"))
    depends_on("py-pyfftw@0.14:", type=("build", "run"))
    depends_on("py-tqdm@4.60:", type=("build", "run"))
    depends_on("py-mpi4py@4:", type=("build", "run"), when="+mpi")
    depends_on("py-h5py+mpi", type=("build", "run"), when="+mpi")
    depends_on("py-matplotlib@3.8:", type=("build", "run"), when="+plot")
