"""``python -m midway.cli``."""

from midway.cli.main import main

main()
