"""The users of the dashboard: names, passwords and read-only users, in a file.

The store never deletes anything and is copied into backups, but an old password must disappear: users therefore have a
separate file.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import threading
import unicodedata
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from argon2 import PasswordHasher
from argon2.exceptions import Argon2Error, InvalidHashError

from compgen.data.files import sha256_of, write_file
from compgen.errors import InputError
from compgen.fleet.records import AUTOMATIC

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
SHORTEST, LONGEST = 12, 256
#: Largest number of hashes calculated at the same time; each takes 64 MiB.
AT_ONCE = 2


class Users:
    """The users file; it is read again for every query, so a change takes effect at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._hasher = PasswordHasher()  # Argon2id with the parameters of RFC 9106, section 4, second choice
        self._slots = threading.BoundedSemaphore(AT_ONCE)

    def names(self) -> list[str]:
        """Return the names of all users."""
        return sorted(self._read()[0])

    def stamp(self, name: str) -> str | None:
        """Return what changes with the user's password; None for an unknown user."""
        found = self._read()[0].get(name)
        return None if found is None else sha256_of(found.encode())

    def may_decide(self, name: str) -> bool:
        """Whether the user exists and is not just a reader."""
        users, readers = self._read()
        return name in users and name not in readers

    def verify(self, name: str, password: str) -> bool:
        """Whether the password is right; an unknown name takes as long as a wrong password."""
        found = self._read()[0].get(name)
        if len(password) > LONGEST:
            return False
        with self._slots:
            try:
                right = self._hasher.verify(found or _nobody(), _normal(password))
            except (Argon2Error, InvalidHashError):
                return False
        return right and found is not None

    def add(self, name: str, password: str, *, reader: bool = False) -> bool:
        """Add a user or change password and rights; return whether the user is new. InputError for invalid values.

        A ``reader`` sees what needs a login, but cannot decide.
        """
        check_name(name)
        check_password(name, password)
        users, readers = self._read()
        new = name not in users
        others = {known.lower() for known in users if known != name}
        if name.lower() in others:
            raise InputError(f"{name!r} differs from another user only in upper and lower case; choose another name")
        users[name] = self._hasher.hash(_normal(password))
        self._write(users, readers | {name} if reader else readers - {name})
        return new

    def remove(self, name: str) -> None:
        """Remove a user, whose sessions end at once; InputError for an unknown user."""
        users, readers = self._read()
        if name not in users:
            raise InputError(f"has no user {name!r}", file=self.path)
        del users[name]
        self._write(users, readers - {name})

    def _read(self) -> tuple[dict[str, str], frozenset[str]]:
        """Return the hashes by name, and the read-only users."""
        try:
            with self.path.open(encoding="utf-8") as stream:
                if os.name == "posix" and os.fstat(stream.fileno()).st_mode & 0o022:
                    raise InputError(
                        "other accounts may write to this file of users; run chmod 600 on it", file=self.path
                    )
                data = json.load(stream)
        except FileNotFoundError:
            return {}, frozenset()
        except (OSError, ValueError) as error:
            raise InputError(f"cannot be read as a file of users: {error}", file=self.path) from error
        users = data.get("users") if isinstance(data, dict) else None
        if not isinstance(users, dict) or not all(isinstance(item, str) for item in users.values()):
            raise InputError("is not a file of users; create one with `volcomp serve add-user`", file=self.path)
        readers = data.get("readers", [])
        if not isinstance(readers, list) or not all(isinstance(item, str) for item in readers):
            raise InputError(
                "has a malformed list of readers; create it again with `volcomp serve add-user`", file=self.path
            )
        return users, frozenset(readers)

    def _write(self, users: Mapping[str, str], readers: frozenset[str]) -> None:
        """Replace the file atomically; only its owner may read it."""
        text = json.dumps({"users": dict(sorted(users.items())), "readers": sorted(readers)}, indent=2) + "\n"
        write_file(self.path, text, private=True)


@cache
def _nobody() -> str:
    """Return a hash to compare with if the user does not exist."""
    return PasswordHasher().hash(secrets.token_urlsafe())


def check_name(name: str) -> None:
    """Raise InputError unless ``name`` is a valid user name."""
    if not NAME.fullmatch(name):
        raise InputError(f"{name!r} is not a name: letters, digits and . _ @ -, at most 64, are allowed")
    if name.lower() == AUTOMATIC:
        raise InputError(f"{name!r} is reserved for automatic decisions; choose another name")


def check_password(name: str, password: str) -> None:
    """Raise InputError for a password that is too short, too long, or equal to the name."""
    if not SHORTEST <= len(password) <= LONGEST:
        raise InputError(f"a password has {SHORTEST} to {LONGEST} characters; this one has {len(password)}")
    if name.lower() in password.lower() or len(set(password)) < 5:
        raise InputError(
            "this password is easy to guess: it contains the name, or fewer than five different characters"
        )


def _normal(password: str) -> str:
    """Return a common form for letters that keyboards encode in several ways."""
    return unicodedata.normalize("NFC", password)
