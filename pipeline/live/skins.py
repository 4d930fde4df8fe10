"""Several skins at work, each on a thread of its own: what `reskin.open` gives for a list of ports.

In: skins that are not open yet. Out: the latest contact of each. Refuses to wait for one of them because of another.
"""

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from types import TracebackType

from pipeline.live.skin import Contact, Skin


class Skins:
    """Boards on ports, opened and zeroed at once. Iterate for the latest contacts, in the order of the ports."""

    def __init__(self, skins: Sequence[Skin]) -> None:
        self.skins = skins
        self._latest: list[Contact | None] = [None] * len(skins)
        self._failed: Exception | None = None
        self._news, self._came, self._stop = False, threading.Condition(), threading.Event()
        self._opened = ExitStack()
        self._threads = [
            threading.Thread(target=self._follow, args=[i], name=f"contacts of {skin.port}", daemon=True)
            for i, skin in enumerate(skins)
        ]

    def __enter__(self) -> "Skins":
        """Open all ports; nothing may touch the skins meanwhile. If one board is not there, none is left open."""
        with self._opened as opening, ThreadPoolExecutor(len(self.skins)) as pool:
            for entering in [pool.submit(opening.enter_context, skin) for skin in self.skins]:
                entering.result()
            self._opened = opening.pop_all()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._opened.close()

    def __iter__(self) -> Iterator[tuple[Contact, ...]]:
        """Give the latest contact of each board whenever one has a new one; a silent board's is NaN and says why."""
        while True:
            with self._came:
                self._came.wait_for(lambda: self._failed or (self._news and None not in self._latest))
                if self._failed is not None:
                    raise self._failed
                self._news = False
                latest = tuple(contact for contact in self._latest if contact is not None)
            yield latest

    def _follow(self, index: int) -> None:
        try:
            for contact in self.skins[index]:
                with self._came:
                    self._latest[index], self._news = contact, True
                    self._came.notify()
                if self._stop.is_set():
                    return
        except Exception as error:  # also one of a model: raised where somebody iterates
            with self._came:
                self._failed = error
                self._came.notify()
