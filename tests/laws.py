"""A helper for tests of experiments whose results are checks. Each check has an error, a tolerance and a reason."""


def broken(rows):
    """Return the failed checks with error, tolerance and reason, which pytest prints on failure."""
    return [row for row in rows if not row.holds]
