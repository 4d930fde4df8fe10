"""Helper for tests of the checks and cases that experiments tabulate."""


def broken(rows):
    """Return the rows that do not hold; pytest shows their error, tolerance and reason."""
    return [row for row in rows if not row.holds]
