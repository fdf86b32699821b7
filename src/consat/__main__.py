"""``python -m consat``."""

from consat.cli.main import main

main()
