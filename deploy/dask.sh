#!/bin/sh
# Work past one machine, in three words. Every machine sees this checkout, its .venv included, under the same path.
#   sh deploy/dask.sh scheduler [PORT]        until it is ended; prints its address
#   sh deploy/dask.sh worker ADDRESS [N]      N workers of one thread (1); end with the scheduler, wait 5 minutes for it
#   sh deploy/dask.sh run ADDRESS COMMAND...  the command, its trainings and simulations on those workers
# There is no password: let nobody else reach the port.
set -eu
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE="" PATH="$PWD/.venv/bin:$PATH"
word=${1:-}
[ $# -gt 0 ] && shift
case $word in
scheduler)
    exec python -m distributed.cli.dask_scheduler --port "${1:-8786}" --no-dashboard --no-jupyter
    ;;
worker) # through the package, which sets what libraries read when they load
    exec python -c "import pipeline.cluster; from distributed.cli.dask_worker import main; main()" \
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
