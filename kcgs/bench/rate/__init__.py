"""Quality against the sizes of real files, beside other codecs: `kcgs bench rate`."""

from .experiment import run

__all__ = ["run"]
