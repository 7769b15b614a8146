"""`python -m app.cli` is `isodyn`."""

from app.cli import main

main()
