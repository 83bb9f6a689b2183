"""`python -m scenefuse`: the command `scenefuse`."""

from scenefuse.command_line import main

main()
