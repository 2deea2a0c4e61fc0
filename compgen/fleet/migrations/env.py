"""Runs the migrations on the connection that :mod:`compgen.fleet.database` hands over."""

from alembic import context


def run() -> None:
    """Run what Alembic asks for, in the transaction of the caller."""
    context.configure(connection=context.config.attributes["connection"], transaction_per_migration=False)
    with context.begin_transaction():
        context.run_migrations()


try:
    context.config  # noqa: B018 - there only while Alembic runs this file; an import alone does nothing
except (NameError, AttributeError):
    pass
else:
    run()
