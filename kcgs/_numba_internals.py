"""The private names of numba that kcgs uses.

`tests/test_private_names.py` lists each name, and what breaks if numba removes it.
"""

from __future__ import annotations

import pickle
from typing import Any

from numba.core import cgutils, config
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

# for other modules: the user's cache folder; the base of kcgs' cache; loops and variables of LLVM code; settings of the
# environment
__all__ = ["AppDirs", "NullCache", "cgutils", "config", "from_bytes", "set_cache", "to_bytes"]


def set_cache(dispatcher: Any, cache: NullCache) -> None:
    """Keep the compiled code of a function in a cache of kcgs."""
    dispatcher._cache = cache


def to_bytes(result: Any) -> bytes:
    """Return the compiled code of a function as a pickle."""
    content: bytes = dumps(result._reduce())
    return content


def from_bytes(context: Any, content: bytes) -> Any:
    """Return the compiled code of a function from its pickle."""
    return CompileResult._rebuild(context, *pickle.loads(content))
