"""A PostgreSQL server of its own for the tests: in a temporary folder, on a socket in it, as an ordinary user."""

import ctypes
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

PROGRAMS = ("initdb", "postgres")
#: Nothing has to outlive a power failure here.
FAST = ("fsync=off", "full_page_writes=off", "shared_buffers=16MB", "max_connections=40")
PATIENCE_S = 60.0
#: The databases of all tests take a quarter of it.
ENOUGH_BYTES = 2_000_000_000


def folder_of_programs():
    """Folder that holds initdb and postgres, or None."""
    found = shutil.which("initdb")
    places = [Path(found).resolve().parent] if found else []
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name), reverse=True)
    return next((place for place in places if all((place / name).exists() for name in PROGRAMS)), None)


def _account():
    """Options of subprocess that make a program run as an ordinary user: PostgreSQL refuses root."""
    if os.getuid() != 0:
        return {}
    for name in ("postgres", "nobody"):
        try:
            entry = pwd.getpwnam(name)
        except KeyError:
            continue
        return {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}
    return {}


def _end_with_parent():
    """Ask the system to end this process when the tests end, however they end."""
    set_death_signal = 1
    ctypes.CDLL(None).prctl(set_death_signal, signal.SIGQUIT)


def _place():
    """Memory where there is enough of it, else the disk; a short name in both, as the path of a socket is limited."""
    memory = Path("/dev/shm")
    return memory if memory.is_dir() and shutil.disk_usage(memory).free > ENOUGH_BYTES else Path("/tmp")


class Server:
    """A running server; databases are made one after the other. ``network``: it also takes whoever comes from there."""

    def __init__(self, network=""):
        self.network = network
        self.programs, self.account, self.count = folder_of_programs(), _account(), 0
        self.folder = Path(tempfile.mkdtemp(prefix="compgen-pg-", dir=_place()))
        try:
            if self.account:
                os.chown(self.folder, self.account["user"], self.account["group"])
            self._do("initdb", "--pgdata=data", "--username=tester", "--auth=trust", "--no-sync", "--encoding=UTF8")
            if network:
                with (self.folder / "data" / "pg_hba.conf").open("a") as rules:
                    rules.write(f"host all all {network} trust\n")
            self.start()
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _do(self, name, *words):
        command = [str(self.programs / name), *words]
        environment = {"PATH": "/usr/bin:/bin", "LC_ALL": "C", "TZ": "UTC"}
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False, **self.account
        )
        assert done.returncode == 0, (command, done.stderr)

    def start(self):
        """Start the server and wait until it answers."""
        own = (f"listen_addresses={'*' if self.network else ''}", f"unix_socket_directories={self.folder}")
        settings = [word for setting in (*FAST, *own) for word in ("-c", setting)]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [str(self.programs / "postgres"), "-D", "data", *settings],
                cwd=self.folder,
                env={"LC_ALL": "C", "TZ": "UTC"},
                stdout=log,
                stderr=log,
                preexec_fn=_end_with_parent,
                **self.account,
            )
        until = time.monotonic() + PATIENCE_S
        while not self._answers():
            assert self.process.poll() is None, (self.folder / "log").read_text()
            assert time.monotonic() < until, (self.folder / "log").read_text()
            time.sleep(0.02)

    def _answers(self):
        import psycopg

        try:
            psycopg.connect(self.address("postgres")).close()
        except psycopg.OperationalError:
            return False
        return True

    def stop(self, *, crash=False):
        """Stop the server; with ``crash`` as a power failure would, without a word to those who are connected."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGQUIT if crash else signal.SIGINT)
        self.process.wait(PATIENCE_S)

    def close(self):
        """Stop the server and remove everything of it."""
        self.stop(crash=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def address(self, name, user="tester"):
        """Address of a database as a store takes it."""
        return f"postgresql://{user}@/{name}?host={self.folder}"

    def sql(self, text, name="postgres"):
        """Do something as the owner of everything; rows if there are any."""
        import psycopg

        with psycopg.connect(self.address(name), autocommit=True) as connection:
            cursor = connection.execute(text)
            return cursor.fetchall() if cursor.description else []

    def database(self):
        """Make a new, empty database and return its address."""
        self.count += 1
        self.sql(f"CREATE DATABASE store{self.count}")
        return self.address(f"store{self.count}")
