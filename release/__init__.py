"""Tools of a release: versions and licences. Not part of the wheel."""
