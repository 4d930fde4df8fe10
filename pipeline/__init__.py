"""Learning for magnetic tactile skins: from raw serial captures to the tables of the ReSkin paper."""
