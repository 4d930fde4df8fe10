"""Whether the tracking server answers, within seconds. Knows nothing of what is written there."""

import http.client
import os
import urllib.error
import urllib.request

VARIABLE = "MLFLOW_TRACKING_URI"
TIMEOUT_S = 2.0


class TrackingAway(Exception):
    """The tracking server does not answer; the message says what to do."""


def server_uri() -> str | None:
    """The tracking server that the user named, if any; without one the embedded store is used."""
    return os.environ.get(VARIABLE) or None


def probe(uri: str | None) -> None:
    """Raise `TrackingAway` if a server (http, https) does not answer within two seconds."""
    if uri is None or not uri.startswith(("http://", "https://")):
        return
    try:
        with urllib.request.urlopen(f"{uri.rstrip('/')}/health", timeout=TIMEOUT_S):
            return
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        reason = getattr(error, "reason", error) or type(error).__name__
        raise TrackingAway(
            f"MLflow at {uri} does not answer ({reason}). Results are made all the same; "
            "`reskin publish` sends them when it is back."
        ) from None
