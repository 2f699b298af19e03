"""`python -m kcgs.cli`."""

from . import main

main()
