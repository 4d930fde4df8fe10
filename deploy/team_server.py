"""Run a team's MLflow server on PostgreSQL until Ctrl-C: python -m deploy.team_server FOLDER.

FOLDER keeps the database and the artifacts for the next start. PostgreSQL listens only on loopback and has a generated
password. MLflow has no password: put its port behind a firewall or a proxy.
"""

import argparse
import signal
import sys
import time
from pathlib import Path

from deploy.servers import LOOPBACK, ServerError, free_port, listens, mlflow, postgres

LOOK_EVERY_s = 2.0


def main() -> None:
    """Start both servers, print how to use them, and wait."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--host", default=LOOPBACK, help="address to listen on; 0.0.0.0: all addresses")
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
            raise ServerError(f"MLflow no longer responds at {address}. See {folder}/mlflow.log.")
    except ServerError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("stopped")


if __name__ == "__main__":
    main()
