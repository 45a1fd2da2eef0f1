"""`python -m disco_hw` is `disco-hw`."""

from disco_hw.cli import main

main()
