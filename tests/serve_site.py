"""The dashboard as tests use it: in a client of the framework, or on a real port; passwords are hashed cheaply."""

import contextlib
import functools
import re
import tempfile
import threading
from pathlib import Path

import serve_factory as factory
from argon2 import PasswordHasher

from compgen.fleet.dashboard import users
from compgen.fleet.dashboard.app import make_app
from compgen.fleet.dashboard.server import make_server
from compgen.fleet.dashboard.settings import DashboardSettings
from compgen.fleet.dashboard.users import Users
from compgen.fleet.store import open_store

OWN = "http://localhost:8765"
PASSWORD = "correct horse battery"
PAGES = (
    "/",
    "/machines/1",
    "/machines/1/drift",
    "/machines/1/tables/3",
    "/machines/4",
    "/machines/4/tables/2",
    "/audit",
    "/login",
    "/nowhere",
)
DECISIONS = (
    ("/machines/1/tables/3/approve", {"reason": "fine", "seen": "2"}),
    ("/machines/1/tables/3/reject", {"reason": "no", "seen": "2"}),
    ("/machines/1/rollback", {"reason": "worse", "to": "1", "seen": "2"}),
)


@contextlib.contextmanager
def cheap_hashes():
    """Hash passwords with the least memory and time, so that tests do not wait for what only guessing should."""
    real, users.PasswordHasher = (
        users.PasswordHasher,
        functools.partial(PasswordHasher, time_cost=1, memory_cost=8, parallelism=1),
    )
    users._nobody.cache_clear()
    try:
        yield
    finally:
        users.PasswordHasher = real
        users._nobody.cache_clear()


@functools.cache
def prepared():
    """Contents of a store and of a file of users; made once, as hashes and migrations take their time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        factory.make_factory(folder / "store.sqlite").close()
        with cheap_hashes():
            Users(folder / "users.json").add("meyer", PASSWORD)
            Users(folder / "users.json").add("reader", PASSWORD, reader=True)
        return {path.name: path.read_bytes() for path in folder.iterdir()}


def put(folder):
    """Put store and users into a folder."""
    for name, content in prepared().items():
        (folder / name).write_bytes(content)
        (folder / name).chmod(0o600)


class Clock:
    """Seconds that a test moves on."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


class Site:
    """The dashboard in a test client, as a browser at OWN uses it."""

    def __init__(self, folder, **options):
        put(folder)
        self.store = open_store(str(folder / "store.sqlite"))
        with cheap_hashes():
            self.users = Users(folder / "users.json")
            self.clock = Clock()
            options = {"decide": True, "users": self.users.path} | options
            self.settings = DashboardSettings(str(folder / "store.sqlite"), **options)
            self.app = make_app(self.settings, self.store, self.clock)
        self.client = self.app.test_client()

    def get(self, path, **options):
        return self.client.get(path, base_url=OWN, **options)

    def post(self, path, data=None, *, headers=None):
        return self.client.post(path, base_url=OWN, data=data, headers={"Origin": OWN} if headers is None else headers)

    def token(self, path="/"):
        return re.findall(r'name="csrf" value="([^"]+)"', self.get(path).text)[-1]

    def login(self, name="meyer", password=PASSWORD, **fields):
        with cheap_hashes():
            csrf = self.token("/login")
            return self.post("/login", {"name": name, "password": password, "csrf": csrf, **fields})

    def cookie(self, name="session"):
        found = self.client.get_cookie(f"compgen-8765-{name}", domain="localhost")
        return None if found is None else found.value


class Served:
    """The dashboard on a real port."""

    def __init__(self, folder):
        put(folder)
        self.store = open_store(str(folder / "store.sqlite"))
        self.settings = DashboardSettings(
            str(folder / "store.sqlite"), port=0, decide=True, users=folder / "users.json"
        )
        with cheap_hashes():
            self.server = make_server(self.settings)
        self.address = ("127.0.0.1", int(self.server.effective_port))
        self.url = f"http://127.0.0.1:{self.server.effective_port}"
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        with contextlib.suppress(OSError, ValueError):  # its sockets are closed under it at the end
            self.server.run()

    def close(self):
        self.server.close()
        self.server.asyncore.close_all(self.server._map, ignore_all=True)
        self.thread.join(timeout=20)
        self.server.task_dispatcher.shutdown()
        self.store.close()
