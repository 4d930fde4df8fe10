"""Learning for magnetic tactile skins: from raw serial captures to the tables of the ReSkin paper.

Knows nothing itself: below it each folder owns one step, each module one thing.
"""

from pipeline.core.numerics import pin

pin()  # before any module of the package imports NumPy
