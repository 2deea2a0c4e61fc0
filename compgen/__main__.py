"""The console script, also as ``python -m compgen`` where the shell has a built-in of the same name (bash)."""

import sys


def main() -> None:
    """Run the command line; Ctrl-C also ends it cleanly while it is still loading."""
    try:
        from compgen.cli import main as command_line
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        sys.exit(130)
    command_line()


if __name__ == "__main__":
    main()
