"""One thread for the linear algebra of searches on the host.

The matrices of a search are small: several threads gain nothing on them, and on a busy machine they wait for each other at
every product (measured with two threads on two cores that four others use: 30 times longer).
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator
from typing import Any

from threadpoolctl import ThreadpoolController


class _Libraries:
    """The loaded libraries, and how many searches want them to use one thread."""

    def __init__(self):
        self.controller, self.lock = ThreadpoolController(), threading.Lock()
        self.users, self.limit = 0, None

    def changed(self, by: int) -> None:
        """Take in or let go a search; the first sets the limit, the last takes it away."""
        with self.lock:
            self.users += by
            if self.users and self.limit is None:
                self.limit: Any = self.controller.limit(limits=1, user_api="blas")
            elif not self.users and self.limit is not None:
                self.limit.restore_original_limits()
                self.limit = None


_libraries = functools.cache(_Libraries)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Products and factorisations of NumPy and SciPy within it take one thread; costs twenty microseconds."""
    libraries = _libraries()
    libraries.changed(1)
    try:
        yield
    finally:
        libraries.changed(-1)
