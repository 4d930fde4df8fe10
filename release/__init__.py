"""Tools for releases: versions and licences. Not part of the wheel."""
