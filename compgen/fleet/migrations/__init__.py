"""Alembic's scripts that bring an older store to the present schema."""
