"""Contents of files in the store: kept once each, by their SHA-256, deflated."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Any

import sqlalchemy as sa

from compgen.core.files import sha256_of
from compgen.recal import schema


def put_blobs(connection: sa.Connection, contents: Iterable[bytes]) -> list[str]:
    """Keep contents that are not there yet and return their SHA-256."""
    digests = []
    for content in contents:
        digest = sha256_of(content)
        known = connection.execute(sa.select(schema.blobs.c.size).where(schema.blobs.c.sha256 == digest)).first()
        if known is None:
            insert = _insert_once(connection)
            row = {"sha256": digest, "size": len(content), "deflated": zlib.compress(content, 6)}
            connection.execute(insert.values(**row).on_conflict_do_nothing())
        digests.append(digest)
    return digests


def _insert_once(connection: sa.Connection) -> Any:
    from sqlalchemy.dialects import postgresql, sqlite

    kind = postgresql if connection.dialect.name == "postgresql" else sqlite
    return kind.insert(schema.blobs)
