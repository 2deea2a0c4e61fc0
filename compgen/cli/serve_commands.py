"""``volcomp serve``: the dashboard, and who may log in."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from compgen.cli.common import json_option, print_json, stdout
from compgen.errors import InputError

if TYPE_CHECKING:
    from compgen.serve.users import Users


def _missing(error: ImportError) -> InputError:
    return InputError(f"{error.name} is not installed; the dashboard needs: pip install 'compgen[serve]'")


@click.group("serve", invoke_without_command=True)
@click.option(
    "--store", metavar="URL", help="sqlite:///FILE, a path, or postgresql://HOST/NAME; default: that of --job."
)
@click.option("--job", type=click.Path(path_type=Path), metavar="FILE", help="Job file whose folders follow decisions.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address on which it listens.")
@click.option("--port", default=8765, show_default=True, type=click.IntRange(0, 65535), help="Port; 0: any free one.")
@click.option("--name", "names", multiple=True, metavar="HOST", help="Further host name that browsers use.")
@click.option("--decide", is_flag=True, help="Let users who are logged in approve, reject and roll back.")
@click.option("--private", is_flag=True, help="Reading needs a login too.")
@click.option("--behind-tls", is_flag=True, help="A proxy in front speaks HTTPS; cookies go over HTTPS only.")
@click.option(
    "--users", type=click.Path(path_type=Path), metavar="FILE", help="Users; default: beside the SQLite store."
)
@click.option(
    "--metrics-token-file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Holds the token without which /metrics is not shown.",
)
@click.option("--log", type=click.Choice(["auto", "json", "text"]), default="auto", help="Form of the logs on stderr.")
@click.pass_context
def serve_command(
    context: click.Context,
    store: str | None,
    job: Path | None,
    host: str,
    port: int,
    names: tuple[str, ...],
    decide: bool,
    private: bool,
    behind_tls: bool,
    users: Path | None,
    metrics_token_file: Path | None,
    log: str,
) -> int:
    """Show the fleet in a browser: history, drift, before and after of proposed tables.

    It only reads, and only this computer reaches it, unless options say otherwise. Runs until SIGTERM or Ctrl-C.

    \b
    Example:
      volcomp serve add-user meyer --users users.json
      volcomp serve --job recal.toml --decide --users users.json
    """
    if context.invoked_subcommand is not None:
        return 0
    try:
        from compgen.recal import logs
        from compgen.serve.server import run
        from compgen.serve.settings import Settings, default_users
    except ImportError as error:
        raise _missing(error) from error
    url = _store_url(store, job)
    token = None if metrics_token_file is None else _token(metrics_token_file)
    file = users if users is not None else default_users(url)
    logs.configure(log)  # type: ignore[arg-type]  # one of the choices
    run(Settings(url, host, port, names, decide, private, behind_tls, file, job, token))
    return 0


def _store_url(store: str | None, job: Path | None) -> str:
    """Return the store that is meant; decisions and pages must speak of the same one."""
    if job is None:
        if store is None:
            raise click.UsageError("give --store URL or --job FILE")
        return store
    from compgen.recal.database import shown
    from compgen.recal.job import read_job

    url = read_job(job).store
    given = url if store is None else store if "://" in store else f"sqlite:///{Path(store).absolute()}"
    if given != url:
        raise InputError(f"{shown(given)} is not the store of {job}, {shown(url)}; leave it out", field="--store")
    return url


def _token(path: Path) -> str:
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", file=path) from error
    if len(token) < 16 or not token.isascii():
        raise InputError("a token of at least 16 ASCII characters is expected", file=path)
    return token


def _users(users: Path | None, store: str | None) -> Users:
    try:
        from compgen.serve.settings import default_users
        from compgen.serve.users import Users
    except ImportError as error:
        raise _missing(error) from error
    file = users if users is not None else default_users(store) if store else None
    if file is None:
        raise click.UsageError("give --users FILE, or --store FILE of an SQLite store")
    return Users(file)


_users_option = click.option("--users", type=click.Path(path_type=Path), metavar="FILE", help="File of the users.")
_store_option = click.option("--store", metavar="URL", help="SQLite store; the file of its users lies beside it.")


@serve_command.command("add-user")
@click.argument("name")
@_users_option
@_store_option
@click.option("--password-stdin", is_flag=True, help="Read the password from the first line of stdin.")
@click.option("--reader", is_flag=True, help="The user reads what --private shows, and decides nothing.")
def add_user(name: str, users: Path | None, store: str | None, password_stdin: bool, reader: bool) -> int:
    """Add a user, or change password and rights, which ends the user's sessions.

    The password is asked for twice and kept as an Argon2id hash only.

    \b
    Example:
      volcomp serve add-user meyer --users users.json
    """
    file = _users(users, store)
    from compgen.serve.users import check_name

    check_name(name)
    if password_stdin:
        password = sys.stdin.readline().rstrip("\r\n")
    else:
        password = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    new = file.add(name, password, reader=reader)
    stdout.print(f"{name} {'is added' if new else 'has a new password'}: {file.path}", soft_wrap=True)
    return 0


@serve_command.command("remove-user")
@click.argument("name")
@_users_option
@_store_option
def remove_user(name: str, users: Path | None, store: str | None) -> int:
    """Remove a user; sessions of that name end at once.

    \b
    Example:
      volcomp serve remove-user meyer --users users.json
    """
    file = _users(users, store)
    file.remove(name)
    stdout.print(f"{name} is removed: {file.path}", soft_wrap=True)
    return 0


@serve_command.command("users")
@_users_option
@_store_option
@json_option
def list_users(users: Path | None, store: str | None, as_json: bool) -> int:
    """List who may log in.

    \b
    Example:
      volcomp serve users --users users.json
    """
    names = _users(users, store).names()
    if as_json:
        print_json({"users": names})
    else:
        stdout.print("\n".join(names) or "nobody may log in")
    return 0


COMMANDS = (serve_command,)
