"""Options that several commands share, and the objects they pass on: a machine, tables, limits, workers."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from compgen import effects
from compgen.cli.common import NUMBER, PATH, Command, options_of
from compgen.controls import CONTROLLERS, HEAT_OUTPUTS, ROTARY_PITCH, ROTARY_TARGETS, controller_named
from compgen.data.error_table import ErrorTable
from compgen.data.machine import (
    FEW_MM,
    MOST_ZONE_WEIGHT,
    ZONE_WEIGHT,
    Emphasis,
    Machine,
    Vector3,
    load_machine,
    zone_of,
)
from compgen.data.names import AXES
from compgen.errors import CompgenWarning, InputError, nearest
from compgen.foreign.answers import ImportOptions
from compgen.identification import Covariance, IdentifyOptions, read_covariance, read_stations
from compgen.identification.covariance import covariance_named_by
from compgen.identification.options import StatedNumbers
from compgen.resources import data_folder

if TYPE_CHECKING:
    from compgen.identification.heat_of_readings import HeatSource
    from compgen.parallel import Map
    from compgen.tables.active import ActiveTables


def path_option(name: str, text: str, *, metavar: str | None = "FILE", **how: Any) -> Callable[[Command], Command]:
    """Add an option that takes a path."""
    return click.option(name, metavar=metavar, type=PATH, help=text, **how)


def open_machine(
    name: str, machines: Sequence[Path] = (), *, whole: bool = False, used: Iterable[str | None] = ()
) -> Machine:
    """Load a machine; check the effects that its file names, and the settings of the controls that a command uses.

    What is wrong with other controls is a warning, unless the ``whole`` file is to be read. A name that no control has may be
    that of a used one, misspelt, whose settings would be missing: an error where a control is used. A shipped machine file
    is known to be right (a test reads all of it): those of its controls that the command does not use are not even imported.
    """
    machine, in_use = load_machine(name, tuple(machines)), {control for control in used if control is not None}
    shipped = machine.source is not None and machine.source.resolve().parent == data_folder("machines")
    for controller in machine.controllers:
        try:
            if whole or not shipped or controller not in CONTROLLERS:
                check_settings(machine, controller)
        except InputError as error:
            misspelt = bool(in_use) and controller not in CONTROLLERS
            if whole or misspelt or (controller in in_use and len(in_use) == 1):
                raise
            if controller in in_use:  # of several controls the others get their tables; this one says why it gets none
                continue
            warnings.warn(f"{error}. This command does not use these settings", CompgenWarning, stacklevel=2)
    if machine.effects:
        effects.active_effects(machine)
    return machine


def check_settings(machine: Machine, controller: str) -> None:
    """Raise InputError for a section ``[controllers.NAME]`` of a control that does not exist, or with wrong settings."""
    if controller in CONTROLLERS:
        CONTROLLERS[controller].read_settings(machine)
        return
    if controller in ROTARY_TARGETS:
        from compgen.controls.rotary_parameters import target_of

        target_of(machine, controller)
        return
    if controller in ROTARY_PITCH:
        from compgen.controls.rotary_pitch import format_of

        format_of(machine, controller)
        return
    from compgen.registry import why_missing

    if controller in HEAT_OUTPUTS:
        from compgen.controls.heat_outputs import output_of

        output_of(machine, controller)
        return
    names = [*CONTROLLERS, *ROTARY_TARGETS, *ROTARY_PITCH, *HEAT_OUTPUTS]
    message = f"is not a controller; {nearest(controller, names)}"
    message += why_missing(CONTROLLERS.broken, controller) or "; if it comes from a plug-in, add --plugin PATH"
    raise machine.controller_settings(controller).fail("", message, kind="unknown")


def machine_argument(command: Command) -> Command:
    """Add MACHINE and --machines; the command receives ``machine`` as a loaded machine."""

    @functools.wraps(command)
    def wrapper(*args: Any, machine: str, machines: tuple[Path, ...], **options: Any) -> Any:
        used = (*_names(options.get("controller")), options.get("active_controller"))
        opened = open_machine(machine, machines, used=used)
        if all(axis.length_mm < FEW_MM for axis in opened.axes):
            travel = ", ".join(f"{letter} {axis.length_mm:g}" for letter, axis in zip(AXES, opened.axes, strict=True))
            text = f"the travel of the machine is {travel} mm: was it meant in inch? `volcomp check` asks for each axis"
            warnings.warn(text, CompgenWarning, stacklevel=2)
        return command(*args, machine=opened, **options)

    help_text = "Additional folder with machine files (may be given several times)."
    option = click.option("--machines", multiple=True, type=click.Path(path_type=Path), help=help_text)
    return click.argument("machine", metavar="MACHINE")(option(wrapper))  # type: ignore[return-value]


def controller_option(*, multiple: bool = False) -> Callable[[Command], Command]:
    """Add --controller NAME."""
    text = "Name of the control; `volcomp controllers` lists them." + (
        " May be given several times." if multiple else ""
    )
    return click.option("--controller", "controller", required=True, metavar="NAME", multiple=multiple, help=text)


@contextmanager
def mapper(workers: int, cluster: str | None) -> Iterator[Map]:
    """Yield a ``map`` over this number of local processes, or over a cluster; the builtin ``map`` for one."""
    if workers == 1 and cluster is None:
        yield map
        return
    from compgen.parallel import opened_workers, spread
    from compgen.plugins import with_plugins

    found = opened_workers(workers, cluster)
    assert found is not None  # true for several workers, and for a cluster

    def spread_out(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        return spread(found, with_plugins(function), items)

    with closing(found):
        yield spread_out


# Options that are declared on the fields of a dataclass: see options_of of compgen/cli/common.py.


#: The options of an identification: noise of the readings, inputs that they share, and the method.
identify_options = options_of(
    IdentifyOptions, "options", read={"stations": lambda given: given if given == "nominal" else read_stations(given)}
)


#: Numbers that are known without a file; the command receives ``stated``.
stated_options = options_of(StatedNumbers, "stated")


#: What files of other programs leave open; the command receives ``answers``.
answer_options = options_of(ImportOptions, "answers")


def fitting_options(command: Command) -> Command:
    """Add smoothness, bounds and loss of the fit; the command receives ``fitting``."""
    from compgen.fitting import FitOptions

    return options_of(
        FitOptions,
        "fitting",
        build=lambda robust, **bounds: FitOptions.from_file_units(*bounds.values(), robust=robust),
    )(command)


def limits_option(command: Command) -> Command:
    """Add --max-step-um; the command receives ``limits``."""
    from compgen.tables.judge import SafetyLimits

    return options_of(SafetyLimits, "limits")(command)


# The covariance of an errors file, for fit and verification.


def covariance_options(command: Command) -> Command:
    """Add --covariance and --independent."""
    text = "Covariance of ERRORS (default: the file that it refers to, if it matches)."
    none = click.option("--independent", is_flag=True, help="Use no covariance; only u_value of each node.")
    return path_option("--covariance", text)(none(command))


def covariance_of(errors: Path, table: ErrorTable, given: Path | None, *, independent: bool) -> Covariance | None:
    """Return the covariance of an errors file: the one given, otherwise the one it refers to, otherwise None.

    A file that belongs to other errors is not used, with a warning.
    """
    if independent:
        if given is not None:
            raise InputError("--covariance cannot be combined with --independent; give only one")
        return None
    if given is not None:
        return read_covariance(given, errors)
    return covariance_named_by(errors, table)


# Options that say where tables must be most accurate: work zone and tools.


def emphasis_options(command: Command) -> Command:
    """Add --zone, --zone-weight and --tools; they override the machine file. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        zone: str | None,
        zone_weight: float | None,
        tools: tuple[str, ...],
        **options: Any,
    ) -> Any:
        return command(*args, machine=emphasised(machine, zone, zone_weight, tools), **options)

    zone_option = click.option(
        "--zone",
        metavar="RANGES",
        help="Work zone (mm) with more weight, e.g. X=-400:0,Y=100:300; default: work_zone_mm of the machine file.",
    )
    weight_option = click.option(
        "--zone-weight",
        metavar="W",
        type=click.FloatRange(1.0, MOST_ZONE_WEIGHT),
        help=f"Weight of a coordinate in the work zone, default {ZONE_WEIGHT:g}; {MOST_ZONE_WEIGHT:g}: almost only the zone.",
    )
    tools_option = click.option(
        "--tools",
        metavar="X,Y,Z",
        multiple=True,
        help="Tool offset (mm) to optimise the tables for; several times for several tools of equal weight.",
    )
    return zone_option(weight_option(tools_option(wrapper)))  # type: ignore[return-value]


def emphasised(machine: Machine, zone: str | None, zone_weight: float | None, tools: tuple[str, ...]) -> Machine:
    """Return the machine with the work zone and the tools of the command line, if given."""
    known = machine.emphasis
    zone_mm = known.zone_mm if zone is None else zone_of(zone, [axis.range_mm for axis in machine.axes])
    if zone_weight is not None and not any(zone_mm):
        raise InputError("--zone-weight needs a work zone; add --zone, or work_zone_mm to the machine file")
    weight = known.zone_weight if zone_weight is None else zone_weight
    tools_mm = tuple(tool_offset("--tools", text) for text in tools) or known.tools_mm
    return replace(machine, emphasis=Emphasis(zone_mm, weight, tools_mm))


def prior_option(command: Command) -> Command:
    """Add --prior, which overrides the section [prior] of the machine file. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(*args: Any, machine: Machine, prior: str | None, **options: Any) -> Any:
        return command(*args, machine=with_prior_class(machine, prior), **options)

    return prior_value(wrapper)  # type: ignore[return-value]


#: The option alone; the command receives ``prior``, the name of a class or None.
prior_value = click.option(
    "--prior",
    metavar="CLASS",
    help="How large errors are assumed that were not measured: precision, general (default), large, router, printer, "
    "or none; overrides [prior] of the machine file.",
)


def with_prior_class(machine: Machine, prior: str | None) -> Machine:
    """Return the machine with the prior of a class, without one as it is."""
    return machine if prior is None else replace(machine, prior=machine.prior.with_class(prior))


def tool_offset(option: str, text: str) -> Vector3:
    """Read a tool offset X,Y,Z in mm."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = float("nan")
    if not all(abs(part) < 1e6 for part in (x, y, z)):
        message = f"{text[:40]!r} is not a tool offset; expected three numbers in mm, e.g. 0,0,-150"
        raise InputError(message, field=option)
    return x, y, z


# Options about tables that were active while the machine was measured, and about steps of tables.


def active_options(*names: str) -> Callable[[Command], Command]:
    """Add --active and --active-controller (and ``names`` for it); the command receives ``active``, tables or None."""

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def wrapper(
            *args: Any, machine: Machine, active: tuple[Path, ...], active_controller: str | None, **options: Any
        ) -> Any:
            target = options.get("controller")
            tables = _active(machine, active, active_controller, target)
            if tables is not None:
                from compgen.tables.active import keeping_others

                machine = keeping_others(machine, _names(target), tables)
            return command(*args, machine=machine, active=tables, **options)

        help_text = "Table file that was active during the measurement (may be given several times): its effect is "
        help_text += "removed, and the new table replaces it."
        option = path_option("--active", help_text, multiple=True)(wrapper)
        text = "Name of the control that the active tables belong to; default: the one given by --controller."
        named = click.option("--active-controller", *names, "active_controller", metavar="NAME", help=text)
        return named(option)  # type: ignore[return-value]

    return decorate


def heat_of_readings_options(command: Command) -> Command:
    """Add the temperatures of the readings and the model of heat; the command receives ``heat``. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        heat_model: Path | None,
        temperatures: Path | None,
        u_clock_s: float | None,
        **options: Any,
    ) -> Any:
        return command(
            *args, machine=machine, heat=_heat_source(machine, heat_model, temperatures, u_clock_s), **options
        )

    text = "Standard uncertainty of the moment at which readings were taken on the clock of the temperatures, s (default: 60)."
    decorated: Any = click.option("--u-clock-s", type=NUMBER, help=text)(wrapper)
    text = (
        "Temperatures while the readings were taken (*.temperatures.csv), joined by time: the growth that the model of heat "
        "tells is taken out of the readings, and its uncertainty enters u."
    )
    decorated = path_option("--temperatures", text)(decorated)
    text = (
        "Model of heat of `volcomp heat` (default with --temperatures: NAME.heat.toml beside the machine file); without "
        "--temperatures the columns temp_..._c of the measurement count."
    )
    return click.option("--heat", "heat_model", metavar="FILE", type=PATH, help=text)(decorated)  # type: ignore[no-any-return]


def _heat_source(
    machine: Machine, model: Path | None, temperatures: Path | None, u_clock_s: float | None
) -> HeatSource | None:
    if model is None and temperatures is None:
        if u_clock_s is not None:
            raise InputError("--u-clock-s is of --temperatures; add them, or leave it out")
        return None
    if u_clock_s is not None and not 0.0 <= u_clock_s < math.inf:
        raise InputError("must be zero or more", field="--u-clock-s")
    from compgen.heat.joining import U_CLOCK_S
    from compgen.identification.heat_of_readings import heat_source

    if model is None and machine.source is not None:
        beside = Path(machine.source).with_name(f"{machine.name}.heat.toml")
        model = beside if beside.exists() else None
    return heat_source(machine, model, temperatures, U_CLOCK_S if u_clock_s is None else u_clock_s)


def _names(target: Any) -> list[str]:
    """Return the names of the controls to write."""
    return [target] if isinstance(target, str) else list(dict.fromkeys(target or ()))


def _active(machine: Machine, paths: tuple[Path, ...], name: str | None, target: Any) -> ActiveTables | None:
    if not paths:
        if name is not None:
            raise InputError("--active-controller needs --active FILE")
        return None
    from compgen.tables.active import read_active

    targets = _names(target)
    if name is None and len(targets) != 1:
        raise InputError("--active: the control of the tables is not clear; add --active-controller NAME")
    return read_active(machine, paths, name or targets[0])


# Options for a file saved on the user's control; the export follows its style or fills its empty tables.


_SAMPLES = {
    "style_from": "A file saved on your control (may be given several times, e.g. parameters and pitch data): the export follows "
    "its style, and keeps the points and parameters in it, in particular those of other axes.",
    "template_from": "An empty table saved on your control; the export fills in its values.",
}


def sample_options(command: Command) -> Command:
    """Add --style-from and --template-from, which override the machine file. Below machine_argument."""

    @functools.wraps(command)
    def wrapper(
        *args: Any,
        machine: Machine,
        controller: str | tuple[str, ...],
        style_from: tuple[Path, ...],
        template_from: Path | None,
        **options: Any,
    ) -> Any:
        names = (controller,) if isinstance(controller, str) else controller
        changed = with_samples(machine, names, {"style_from": style_from, "template_from": template_from})
        return command(*args, machine=changed, controller=controller, **options)

    result: Any = wrapper
    for key, text in _SAMPLES.items():
        result = path_option("--" + key.replace("_", "-"), text, multiple=key == "style_from")(result)
    return result  # type: ignore[no-any-return]


def with_samples(
    machine: Machine, controllers: Sequence[str], samples: Mapping[str, Path | Sequence[Path] | None]
) -> Machine:
    """Return the machine with the sample files in the settings of the chosen controls that take them.

    Raises InputError for a file that does not exist, and for one that none of the controls takes.
    """
    for key, given in samples.items():
        paths = [given] if isinstance(given, Path) else list(given or ())
        if not paths:
            continue
        flag = "--" + key.replace("_", "-")
        for path in paths:
            if not path.is_file():
                raise InputError(f"{flag}: no such file", file=path)
        taking = [name for name in controllers if controller_named(name).sample_setting == key]
        if not taking:
            known = sorted(name for name, control in CONTROLLERS.items() if control.sample_setting == key)
            raise InputError(f"{flag} is for {', '.join(known) or 'no control'}, not for {', '.join(controllers)}")
        for name in taking:
            names = [str(path.resolve()) for path in paths]
            machine = machine.with_setting(name, key, names if len(names) > 1 else names[0])
    return machine


# Options with the same meaning in all commands.


instrument_option = path_option(
    "--instrument", "Constants and set-up of a six-DOF laser instrument (TOML), for *.sixdof.csv files."
)
templates_option = path_option("--templates", "Folder with your templates, searched first.", metavar="DIR")
unverified_option = click.option(
    "--allow-unverified", is_flag=True, help="Export formats that no public document fully describes."
)
reversal_option = path_option(
    "--reversal",
    "*.reversal.csv (um): the reversal value of each axis along its travel; becomes direction-dependent tables "
    "(default: backlash and lost motion of the machine file).",
)
points_option = path_option("--points", "*.points.csv (mm); default: a grid over the volume.")
explain_option = click.option(
    "--explain",
    is_flag=True,
    help="Write explain.md: what the table corrects, what remains and why, what the next option would gain, limits used.",
)
measurements_argument = click.argument("measurements", nargs=-1, type=PATH)
errors_argument = click.argument("errors", type=PATH)
