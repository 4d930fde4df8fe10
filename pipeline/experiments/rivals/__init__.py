"""What rivals make of a board that nobody calibrated: aligned inputs, a law fitted to pokes, another skin's pokes."""
