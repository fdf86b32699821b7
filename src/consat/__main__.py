"""``python -m consat``."""

from consat.cli import main

main()
