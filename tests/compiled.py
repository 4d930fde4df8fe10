"""Compile bytecode and Numba kernels once, as `make test` does. Otherwise, every test worker would compile them."""

import reskin
from tests.stages.checkout import compile_modules


def compile_kernels() -> None:
    """Compile the kernels of simulated presses and of the universal model, into Numba's cache on disk."""
    noload_uT, b_uT, force_N = reskin.simulate_pokes(reskin.draw_skin(), [[8.0, 8.0, 1.0]])
    model = reskin.load_universal().zero(noload_uT)
    model.label([[8.0, 8.0]], force_N, b_uT)
    model.predict(b_uT)


if __name__ == "__main__":
    compile_modules()
    compile_kernels()
