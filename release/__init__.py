"""What a release takes: versions, licences. Not part of the wheel, and imported by nothing in it."""
