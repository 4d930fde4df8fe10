#!/bin/sh
# Run work on several machines. Every machine must see this checkout, with its .venv, under the same path.
#   sh deploy/dask.sh scheduler [PORT]        start a scheduler and print its address; runs until it is ended
#   sh deploy/dask.sh worker ADDRESS [N]      start N workers (default 1); they end after 5 minutes without a scheduler
#   sh deploy/dask.sh run ADDRESS COMMAND...  run a command, its training and simulations on those workers
# There is no password: make sure that nobody else can reach the port.
set -eu
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE="" PATH="$PWD/.venv/bin:$PATH"
word=${1:-}
[ $# -gt 0 ] && shift
case $word in
scheduler)
    exec python -m distributed.cli.dask_scheduler --port "${1:-8786}" --no-dashboard --no-jupyter
    ;;
worker) # the package is imported first, because it sets variables that libraries read when they are loaded
    exec python -c "import pipeline; from distributed.cli.dask_worker import main; main()" \
        "$1" --nworkers "${2:-1}" --nthreads 1 --no-dashboard --death-timeout 300
    ;;
run)
    address=$1
    shift
    export RESKIN_EXECUTOR="dask:$address"
    exec "$@"
    ;;
*)
    echo "deploy/dask.sh: the first word must be scheduler, worker or run; got '$word'. Try: sed -n 2,6p $0" >&2
    exit 2
    ;;
esac
