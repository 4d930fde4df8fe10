#!/bin/sh
# List the licences of all installed packages, and the known vulnerabilities of the versions in constraints.txt.
# Fails if a licence is not compatible with MIT (but for three packages under GPL or EPL, which release/licences.py names
# and gives reasons for), if a version has a vulnerability, or if a package cannot be audited.
set -e
cd "$(dirname "$0")/.."
python -m release.licences
# pip-audit has an environment of its own, because it is not a dependency of the project.
python -m venv .audit
.audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit
.audit/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip
