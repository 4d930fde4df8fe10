"""A team's MLflow server on PostgreSQL: python -m deploy.team_server FOLDER. Runs until Ctrl-C.

FOLDER holds the database and the artifacts, also for the next start. PostgreSQL listens on loopback only, with a
password of its own; MLflow has no password: put its port behind a firewall or a proxy.
"""

import argparse
import signal
import sys
import time
from pathlib import Path

from deploy.servers import LOOPBACK, ServerError, free_port, listens, mlflow, postgres

LOOK_EVERY_s = 2.0


def main() -> None:
    """Start both servers, say how to use them, and wait."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", default=LOOPBACK, help="the address to listen on; 0.0.0.0: every one of this machine")
    parser.add_argument("--port", type=int, default=5000)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    folder = arguments.folder.resolve()
    try:
        with (
            postgres(folder / "postgres", free_port()) as database,
            mlflow(folder, database, arguments.port, host=arguments.host) as address,
        ):
            print(
                f"MLflow on PostgreSQL, files in {folder}. Each person: export MLFLOW_TRACKING_URI={address}",
                flush=True,
            )
            while listens(address):
                time.sleep(LOOK_EVERY_s)
            raise ServerError(f"MLflow does not answer at {address} any more. See {folder}/mlflow.log.")
    except ServerError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("stopped")


if __name__ == "__main__":
    main()
