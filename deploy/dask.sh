#!/bin/sh
# Run work on several machines. Every machine must see this checkout, with its .venv, under the same path.
#   sh deploy/dask.sh scheduler [PORT]        start a scheduler and print its address; runs until it is ended
#   sh deploy/dask.sh worker ADDRESS [N]      start N workers (default 1); they end after 5 minutes without a scheduler
#   sh deploy/dask.sh run ADDRESS COMMAND...  run a command, its training and simulations on those workers
# All connections use TLS: each start of a scheduler makes a key and a certificate (Dask's Security.temporary) and writes
# them to .reskin/dask/PORT.pem, which only your user can read. Whoever lacks this file can neither connect nor listen.
set -eu
cd "$(dirname "$0")/.."
export OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE="" PATH="$PWD/.venv/bin:$PATH"
word=${1:-}
[ $# -gt 0 ] && shift

# Let all Dask connections of this process require the certificate of the scheduler at a port.
secure() {
    pem="$PWD/.reskin/dask/$1.pem"
    export DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION=True DASK_DISTRIBUTED__COMM__TLS__CA_FILE="$pem"
    for role in SCHEDULER WORKER CLIENT; do
        export "DASK_DISTRIBUTED__COMM__TLS__${role}__CERT=$pem" "DASK_DISTRIBUTED__COMM__TLS__${role}__KEY=$pem"
    done
}

case $word in
scheduler)
    port=${1:-8786}
    mkdir -p .reskin/dask
    (umask 077 && python -c 'from distributed import Security
one = Security.temporary()
print(one.tls_scheduler_key, one.tls_scheduler_cert, sep="")' >".reskin/dask/$port.$$" &&
        mv ".reskin/dask/$port.$$" ".reskin/dask/$port.pem")
    secure "$port"
    exec python -m distributed.cli.dask_scheduler --protocol tls --port "$port" --no-jupyter \
        --no-dashboard --dashboard-address 127.0.0.1:0
    ;;
worker | run)
    address=$1
    shift
    secure "${address##*:}"
    waited_s=0
    until [ -s "$pem" ]; do # the scheduler may be starting
        if [ $((waited_s += 1)) -gt 60 ]; then
            echo "deploy/dask.sh: $pem is missing. Start the scheduler with this script, in this checkout." >&2
            exit 2
        fi
        sleep 1
    done
    if [ "$word" = run ]; then
        export RESKIN_EXECUTOR="dask:$address"
        exec "$@"
    fi
    # the package is imported first, because it sets variables that libraries read when they are loaded
    exec python -c "import pipeline; from distributed.cli.dask_worker import main; main()" \
        "$address" --nworkers "${1:-1}" --nthreads 1 --no-dashboard --dashboard-address 127.0.0.1:0 --death-timeout 300
    ;;
*)
    echo "deploy/dask.sh: the first word must be scheduler, worker or run; got '$word'. Try: sed -n 2,7p $0" >&2
    exit 2
    ;;
esac
