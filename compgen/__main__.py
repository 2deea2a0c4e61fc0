"""``python -m compgen``: the command line, also where the shell has a built-in of the same name (bash)."""

from compgen.cli import main

main()
