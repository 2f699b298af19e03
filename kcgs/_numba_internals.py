"""The private names of numba that kcgs uses.

`tests/test_private_names.py` lists them with what breaks where numba has one no longer.
"""

from __future__ import annotations

import pickle
from typing import Any

from numba.core import cgutils, config
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

# for other modules: loops and variables of LLVM code; settings of the environment; the base of a cache of ours; the
# cache folder of the user
__all__ = ["AppDirs", "NullCache", "cgutils", "config", "from_bytes", "set_cache", "to_bytes"]


def set_cache(dispatcher: Any, cache: NullCache) -> None:
    """Keep what a function compiles to in a cache of ours."""
    dispatcher._cache = cache


def to_bytes(result: Any) -> bytes:
    """Return what a function has compiled to as a pickle."""
    content: bytes = dumps(result._reduce())
    return content


def from_bytes(context: Any, content: bytes) -> Any:
    """Return what a function has compiled to from its pickle."""
    return CompileResult._rebuild(context, *pickle.loads(content))
