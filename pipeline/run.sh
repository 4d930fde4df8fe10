#!/bin/sh
# Runs one stage: sh pipeline/run.sh train_multi --scene quick ... DVC calls it with no environment activated, and in
# copies of the checkout below .dvc/tmp/exps, which hold what git tracks and so no .venv: the nearest one above is taken.
set -eu
stage=$1
shift
module=pipeline.stages.$stage
[ -d "pipeline/experiments/$stage" ] && module=pipeline.experiments.$stage.run
folder=$(pwd)
while :; do
    python="$folder/.venv/bin/python"
    [ -x "$python" ] && exec "$python" -m "$module" "$@"
    [ "$folder" = / ] && break
    folder=$(dirname "$folder")
done
for python in python3 python; do
    if "$python" -c "import pydantic, torch" 2>/dev/null; then
        exec "$python" -m "$module" "$@"
    fi
done
echo "error: stage $stage: a Python with the project's packages must be in .venv or on the PATH; got none. Try: make repro" >&2
exit 2
