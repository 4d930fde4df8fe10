"""Laws that a stage tabulates (`Check`, `Case`), held to here for other inputs."""


def broken(rows):
    """Keep the rows that do not hold; pytest shows their error, tolerance and reason."""
    return [row for row in rows if not row.holds]
