"""python tests/fuzz/fuzz.py TARGET|all SECONDS [KEEP]: look for bytes that a door does not survive.

With `pip install atheris` new bytes follow what code they reach (libFuzzer); without it they are drawn at random from
the corpus, which finds less. What reached new code is kept in the folder KEEP, if one is named. What breaks is left in
the folder as `crash-...`; put it into `corpus/TARGET/`.
"""

import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
CORPUS = Path(__file__).parent / "corpus"
BYTES_MAX_N, MEMORY_MAX_MB, HANG_S = 4096, 2048, 20


def follow(name: str, seconds: int, keep: Path | None) -> None:
    """Let libFuzzer look; new bytes go to a folder of their own, which is thrown away unless it was named."""
    import tempfile

    import atheris

    with atheris.instrument_imports(include=["pipeline"]):
        from tests.fuzz.targets import feed
    for file in (CORPUS / name).iterdir():
        feed(name, file.read_bytes())  # what is imported at first use is no hang
    with tempfile.TemporaryDirectory() as found:
        limits = [f"-max_total_time={seconds}", f"-max_len={BYTES_MAX_N}", f"-rss_limit_mb={MEMORY_MAX_MB}"]
        if keep is not None:
            (keep / name).mkdir(parents=True, exist_ok=True)
        folders = [found if keep is None else str(keep / name), str(CORPUS / name)]
        atheris.Setup(
            [sys.argv[0], *limits, f"-timeout={HANG_S}", "-print_final_stats=1", *folders],
            lambda data: feed(name, data),
        )
        atheris.Fuzz()


def draw(name: str, seconds: int) -> None:
    """Change, cut and repeat what the corpus has."""
    from pipeline.core.seeds import rng_for
    from tests.fuzz.targets import feed

    rng, tried_n, end_s = rng_for(time.time_ns() % 2**31, "fuzz", name), 0, time.monotonic() + seconds
    seeds = [file.read_bytes() for file in sorted((CORPUS / name).iterdir())]
    while time.monotonic() < end_s:
        data = bytearray(seeds[rng.integers(len(seeds))])
        for _ in range(rng.integers(1, 8)):
            at = int(rng.integers(len(data) + 1))
            data[at : at + int(rng.integers(3))] = rng.bytes(int(rng.integers(4)))
        Path("crash-last").write_bytes(data)
        feed(name, bytes(data))
        tried_n += 1
    Path("crash-last").unlink()
    print(f"{name}: {tried_n} inputs in {seconds} s")


def main(name: str, seconds: int, *keep: str) -> None:
    if name == "all":
        names = sorted(folder.name for folder in CORPUS.iterdir())
        for each in names:
            subprocess.run([sys.executable, __file__, each, str(seconds // len(names)), *keep], check=True)
        return
    try:
        import atheris  # noqa: F401
    except ImportError:
        draw(name, seconds)
    else:
        follow(name, seconds, Path(*keep) if keep else None)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
