"""`python -m kcgs`."""

from kcgs.cli import main

main()
