"""`python -m cosfly`."""

from cosfly.cli import main

main()
