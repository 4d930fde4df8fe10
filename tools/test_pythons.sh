#!/bin/sh
# Run `make test` with each supported version of Python that is installed, each in an environment of its own.
set -e
cd "$(dirname "$0")/.."
for version in 3.11 3.12 3.13; do
    if "python$version" -c '' 2>/dev/null; then
        make test PYTHON="python$version" VENV=".venv-$version"
    else
        echo "python$version is not installed: not tested"
    fi
done
