"""Helper for tests of the checks that experiments tabulate."""


def broken(rows):
    """Return the failed checks; pytest shows their error, tolerance and reason."""
    return [row for row in rows if not row.holds]
