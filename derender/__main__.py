"""`python -m derender` is `derender`."""

from derender.cli import main

main()
