"""The programs here run on the distribution's Python inside LinuxCNC; they are no test modules."""

collect_ignore_glob = ["drive.py", "lookup.py"]
