"""Plug-ins: the tutorial works as it stands, and a wrong plug-in is refused with what is missing and where."""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS, controller_named
from compgen.data.lengths import Points
from compgen.plugins import KINDS
from compgen.registry import Kind, Registry, load_entry_points, restored
from compgen.simulation import EFFECTS, INSTRUMENTS

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "docs" / "tutorial-control.md"
BLOCK = re.compile(r"^```(\w+)(?: (\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.fixture(autouse=True)
def registries():
    """Whatever a test registers is gone after it."""
    with restored(KINDS):
        yield


@pytest.fixture
def tutorial(tmp_path, monkeypatch):
    """A folder with the files of the tutorial, in which its commands run; the commands themselves are returned."""
    commands = []
    for language, name, text in BLOCK.findall(TUTORIAL.read_text()):
        if name:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        elif language == "sh":
            commands += text.splitlines()
    monkeypatch.chdir(tmp_path)
    return commands


# --- the tutorial ----------------------------------------------------------------------------------------------------


def test_every_command_of_the_tutorial_works(tutorial, call, example):
    Path("fitted.errors.csv").write_text(compgen.format_errors(example.fitted.errors))
    assert len(tutorial) == 5
    said = {}
    for line in tutorial:
        words = shlex.split(line)
        assert words[:3] == ["volcomp", "--plugin", "shop/shop_csv.py"]
        code, stdout, stderr = call(*words[1:])
        assert code == 0, (line, stdout, stderr)
        said[words[3]] = stdout
    assert "at most max_rows rows per axis" in said["controllers"]
    assert "rows per axis that the control takes" in said["controllers"]
    result = json.loads(Path("check/result.json").read_text())
    assert (result["accepted"], result["controller"]) == (True, "shop-csv")
    assert "EC0Y" in said["verify"]
    assert "passed" in said["crash-test"]
    assert "**+v**" in Path("tables/preflight.md").read_text()
    assert Path("tables/check/check-program.md").is_file()
    assert "shop-csv" not in CONTROLLERS


def test_the_tables_of_the_tutorial_hold_minus_the_positioning_error_of_the_middle(tutorial, example):
    """By hand: the control adds um; at mid-volume the added correction takes the displacement of the tip out."""
    compgen.load_plugins(["shop/shop_csv.py"], installed=False)
    machine, errors = example.machine, example.fitted.errors
    text = compgen.export(machine, errors, "shop-csv").files["SHOP.CSV"]
    assert "\r\n" in text
    rows = [line.split(",") for line in text.splitlines() if line[:2] in ("X,", "Y,", "Z,")]
    assert {row[0] for row in rows} == {"X", "Y", "Z"}
    middle = 0.5 * (machine.lower_mm + machine.upper_mm)
    for axis, letter in enumerate("XYZ"):
        own = np.array([[float(cell) for cell in row[1:]] for row in rows if row[0] == letter])
        along = np.tile(middle, (len(own), 1))
        along[:, axis] = own[:, 0]
        error_um = 1e3 * compgen.exact_error(machine, errors, along)[:, axis]
        bent = (own[:, 1] + error_um) - np.mean(own[:, 1] + error_um)
        assert np.ptp(error_um) > 10.0
        assert np.max(np.abs(bent)) < 0.35 * np.ptp(error_um)


def test_the_round_trip_of_the_tutorial_gives_the_same_bytes(tutorial, example):
    from compgen.tables.exporting import Provenance, export_context, rerender

    compgen.load_plugins(["shop/shop_csv.py"], installed=False)
    machine, errors = example.machine, example.fitted.errors
    made = compgen.export(machine, errors, "shop-csv")
    common = export_context(machine, errors, "shop-csv", Provenance())
    assert rerender(machine, "shop-csv", made.files, common) == dict(made.files)


def test_the_short_control_of_the_tutorial_is_the_same_one(tutorial, example):
    """The base class gives the bytes, the correction and the refusals of the class that is written out."""
    machine, errors, made, read = example.machine, example.fitted.errors, {}, {}
    places = np.random.default_rng(3).uniform(machine.lower_mm - 50.0, machine.upper_mm + 50.0, (80, 3))
    for name in ("csv", "short"):
        compgen.load_plugins([f"shop/shop_{name}.py"], installed=False)
        made[name] = compgen.export(machine, errors, "shop-csv")
        Path("SHOP.CSV").write_bytes(made["csv"].files["SHOP.CSV"].encode())
        tables = compgen.read_tables(machine, "SHOP.CSV", "shop-csv")
        read[name] = tables.correction(machine, Points(places))
        Path("SHORT.CSV").write_text("\n".join(HEADED))
        far = tables.controller.violations(compgen.read_tables(machine, "SHORT.CSV", "shop-csv").tables)
        assert any("covers -10 ... 0 mm of X; the travel is -800 ... 0 mm" in text for text in far)
        assert any("51 " in text and "50" in text for text in far)
        del CONTROLLERS["shop-csv"]
    assert dict(made["csv"].files) == dict(made["short"].files)
    assert np.max(np.abs(read["csv"] - read["short"])) < 1e-15
    assert "which the control ADDS" in made["short"].preflight


def test_a_table_per_axis_without_its_reader_is_refused(tutorial):
    path = Path("shop/shop_short.py")
    path.write_text(without(path.read_text(), "read_file"))
    with pytest.raises(compgen.InputError, match=r"ShopShort has no read_file\(source\)"):
        compgen.load_plugins([path], installed=False)


#: A file of 51 rows, one too many, that covers 10 mm of X.
HEADED = ["axis,position_mm,correction_um", *(f"X,{0.2 * k - 10.0:.3f},{k:.1f}" for k in range(51)), "END", ""]


@pytest.mark.parametrize(
    ("old", "new", "message", "line"),
    [
        ("END", "", "END is missing", None),
        (".000,", ",00,", "expected an axis X, Y or Z and two numbers", 4),
        ("X,", "A,", "an axis X, Y or Z", 4),
        ("axis,position", "axis;position", "the header", 3),
    ],
)
def test_the_parser_of_the_tutorial_refuses_malformed_files(tutorial, example, old, new, message, line):
    compgen.load_plugins(["shop/shop_csv.py"], installed=False)
    text = compgen.export(example.machine, example.fitted.errors, "shop-csv").files["SHOP.CSV"]
    Path("bad.csv").write_text(text.replace(old, new))
    with pytest.raises(compgen.InputError, match=message) as caught:
        compgen.read_tables(example.machine, "bad.csv", "shop-csv")
    assert caught.value.line == line


SCENARIO = """\
name = "small"
seed = 11
[instrument]
type = "laser-tracer"
[[instrument.stations]]
name = "S1"
position_mm = [-420.0, -210.0, -420.0]
dead_length_mm = 151.25
[trajectory]
type = "grid"
"""


def test_the_effect_of_the_tutorial_moves_the_tip_with_time(tutorial, call, small_machine, small_machine_file):
    effect = Path("shop/effects.toml").read_text()
    Path("plain.toml").write_text(SCENARIO)
    Path("warm.toml").write_text(SCENARIO + effect)
    for name in ("plain", "warm"):
        words = ("simulate", small_machine_file, "--scenario", f"{name}.toml", "--out", name)
        code, _, stderr = call(*words, "--plugin", "shop/warm_z.py")
        assert (code, stderr) == (0, "")
    plain, warm = (compgen.read_lengths(f"{name}/small.lengths.csv") for name in ("plain", "warm"))
    sunk_mm = 12e-3 / 3600.0 * plain.covariates["time_s"]
    assert np.max(sunk_mm) > 1e-3
    beam = plain.position_mm + small_machine.tool_offset_mm - [-420.0, -210.0, -420.0]
    expected_mm = -sunk_mm * beam[:, 2] / np.linalg.norm(beam, axis=1)
    bent_share = 1e-3  # the errors turn the beams by up to a millimetre in a metre
    deviation_mm = np.abs(warm.length_mm - plain.length_mm - expected_mm)
    assert np.max(deviation_mm) < bent_share * np.max(sunk_mm)
    code, stdout, _ = call("effects", "--plugin", "shop/warm_z.py", "--json")
    assert json.loads(stdout)["spindle-growth"]["title"].startswith("Growth of the spindle")
    code, _, stderr = call("simulate", small_machine_file, "--scenario", "warm.toml", "--out", "x")
    assert code == 2
    assert "'spindle-growth'" not in stderr or "unknown effect" in stderr
    Path("warm.toml").write_text(SCENARIO + effect + "um_per_day = 1.0\n")
    words = ("simulate", small_machine_file, "--scenario", "warm.toml", "--out", "x", "--plugin", "shop/warm_z.py")
    code, _, stderr = call(*words)
    assert (code, "um_per_hour" in stderr, "warm.toml:" in stderr) == (2, True, True)


# --- wrong plug-ins --------------------------------------------------------------------------------------------------


def shop(change=lambda text: text):
    """The tutorial's plug-in with its code changed; where it lies."""
    path = Path("shop/shop_csv.py")
    path.write_text(change(path.read_text()))
    return path


def without(text, name):
    """The class without one of its methods."""
    method = rf"    def {name}\(self.*?(?=^    def |^def )"
    changed = re.sub(method, "", text, flags=re.MULTILINE | re.DOTALL)
    assert changed != text
    return changed


REQUIRED = (
    "basis(errors)",
    "build(basis, values)",
    "context(tables)",
    "parse(files)",
    "emulate(tables, points)",
    "violations(tables)",
    "resolution_mm()",
)


def refused(path, *texts):
    """Loading is refused with all these texts, in the library and on the command line, and nothing is registered."""
    before = dict(CONTROLLERS)
    with pytest.raises(compgen.InputError) as caught:
        compgen.load_plugins([path], installed=False)
    assert before == CONTROLLERS
    for text in texts:
        assert text in str(caught.value)
    return caught.value


@pytest.mark.parametrize("method", REQUIRED)
def test_a_method_that_is_missing_is_named_with_its_arguments_and_the_place(tutorial, method):
    path = shop(lambda text: without(text, method.partition("(")[0]))
    error = refused(path, "ShopCsv has no", method, "shop_csv.py", "'shop-csv'")
    assert path.read_text().splitlines()[error.line - 1].startswith("class ShopCsv")


def test_the_required_methods_are_those_of_the_base_class():
    from compgen.controls import Controller

    assert {method.partition("(")[0] for method in REQUIRED} == set(Controller.__abstractmethods__)


@pytest.mark.parametrize(
    ("old", "new", "texts"),
    [
        ("def parse(self, files)", "def parse(self)", ["ShopCsv.parse() cannot be"]),
        ("def emulate(self, ", "def emulate(self, settings, ", ["ShopCsv.emulate(settings, tables, points)"]),
        ('    name = "shop-csv"\n', "", ["ShopCsv.name must be 'shop-csv', but is missing"]),
        ('    name = "shop-csv"', '    name = "shop"', ["ShopCsv.name must be 'shop-csv', but is 'shop'"]),
        ("    settings_class = Settings\n", "", ["ShopCsv has no settings_class"]),
        ('{"shop-csv": ', '{"isg-csv": ', ["already used by a built-in one"]),
        ('{"shop-csv": ', '{"Shop CSV": ', ["lower-case letters"]),
        ('{"shop-csv": ', "{1: ", ["lower-case letters"]),
        ('{"shop-csv": ShopCsv}', "[ShopCsv]", ["CONTROLLERS must be a dict from names to controls"]),
        ('{"shop-csv": ShopCsv}', '{"shop-csv": 5}', ["not a subclass of compgen.controls.Controller"]),
        ("CONTROLLERS =", "CONTROLS =", ["contains nothing to register", "CONTROLLERS (controls by name)"]),
        ('    name = "shop-csv"', '    name = "shop-csv"\n    anchored = 1', ["anchored must be True or False"]),
        ('    name = "shop-csv"', '    name = "shop-csv"\n    bidirectional = True', ["needs with_reversal("]),
        (
            "ShopCsv}",
            "ShopCsv}\nShopCsv.__init__ = lambda self: 1 / 0",
            ["ShopCsv() cannot be called as ShopCsv(machine, settings)"],
        ),
        ("import numpy as np", "import no_such_module", ["ModuleNotFoundError", "no_such_module", "shop_csv.py:5: "]),
        ("DIGITS = 1", "DIGITS = = 1", ["SyntaxError", "shop_csv.py:15: "]),
        ("DIGITS = 1", "DIGITS = 1 / 0", ["ZeroDivisionError", "shop_csv.py:15: "]),
        ("DIGITS = 1", "raise SystemExit(0)", ["SystemExit", "shop_csv.py:15: "]),
    ],
)
def test_a_wrong_plug_in_is_refused_with_what_is_wrong(tutorial, old, new, texts):
    def change(text):
        assert old in text
        return text.replace(old, new)

    refused(shop(change), "shop_csv.py", *texts)


@pytest.mark.parametrize(
    ("file", "change", "texts"),
    [
        ("format.toml", None, ["templates/shop-csv with format.toml", "is missing"]),
        ("format.toml", lambda text: text.replace("title", "titel"), ["title", "format.toml"]),
        (
            "format.toml",
            lambda text: text.replace('"shop-csv"', '"shop"'),
            ["the name of the control, 'shop-csv'", "format.toml"],
        ),
        ("SHOP.CSV.j2", None, ["SHOP.CSV.j2: is missing"]),
        ("SHOP.CSV.j2", lambda text: text + "{% if %}", ["SHOP.CSV.j2:", "is not a valid template"]),
        ("preflight.md.j2", None, ["preflight.md.j2: is missing"]),
    ],
)
def test_a_control_without_its_templates_is_refused(tutorial, file, change, texts):
    path = Path("shop/templates/shop-csv") / file
    if change is None:
        path.unlink()
    else:
        path.write_text(change(path.read_text()))
    refused("shop/shop_csv.py", *texts)


def test_everything_that_is_wrong_is_said_at_once(tutorial):
    path = shop(
        lambda text: without(without(text, "parse"), "basis").replace(
            "resolution_mm(self)", "resolution_mm(self, settings)"
        )
    )
    refused(
        path, "basis(errors)", "parse(files)", "resolution_mm(settings) cannot be called as ShopCsv.resolution_mm()"
    )


@pytest.mark.parametrize(
    ("name", "message"),
    [("none.py", "no such plug-in"), ("empty", "no such plug-in"), ("notes.txt", "is not a Python file")],
)
def test_a_path_that_is_no_plug_in_is_refused(tmp_path, name, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("CONTROLLERS = {}")
    refused(tmp_path / name, message, name)


def test_a_wrong_plug_in_exits_with_2_and_stands_in_the_json(tutorial, call):
    shop(lambda text: without(text, "parse"))
    code, stdout, stderr = call("controllers", "--plugin", "shop/shop_csv.py", "--json")
    assert code == 2
    assert "parse(files)" in json.loads(stdout)["error"]
    assert stderr.startswith("error: ")
    assert "Traceback" not in stderr


def test_the_second_of_two_plug_ins_with_one_name_is_refused_and_names_the_first(tutorial, tmp_path):
    import shutil

    shutil.copytree("shop", "other")
    compgen.load_plugins(["shop/shop_csv.py"], installed=False)
    compgen.load_plugins(["shop/../shop/shop_csv.py"], installed=False)
    with pytest.raises(compgen.InputError, match=r"already used by plug-in .*shop/shop_csv\.py"):
        compgen.load_plugins(["other/shop_csv.py"], installed=False)


def test_a_package_folder_with_relative_imports_is_a_plug_in(tutorial, call):
    Path("shop/__init__.py").write_text("from .shop_csv import CONTROLLERS\nfrom .warm_z import EFFECTS\n")
    code, stdout, stderr = call("--plugin", "shop", "controllers", "--json")
    assert (code, stderr) == (0, "")
    listed = json.loads(stdout)
    assert listed["shop-csv"]["plugin"].endswith("/shop")
    assert listed["isg-csv"]["plugin"] is None
    Path("shop/warm_z.py").write_text("import nothing_like_it\n")
    code, _, stderr = call("--plugin", "shop", "controllers")
    assert code == 2
    assert "warm_z.py:1: " in stderr


def test_plug_ins_of_the_environment_are_loaded(tutorial, call, monkeypatch):
    monkeypatch.setenv("COMPGEN_PLUGINS", "shop/shop_csv.py:shop/warm_z.py")
    assert "shop-csv" in call("controllers")[1]
    assert "spindle-growth" in call("effects")[1]


def test_the_settings_of_a_plug_in_are_read_strictly(tutorial, call, small_machine_file):
    machine = Path("m.toml")
    machine.write_text(small_machine_file.read_text() + "[controllers.shop-csv]\nmax_row = 20\n")
    words = ("options", machine, "e.errors.csv")
    code, _, stderr = call(*words, "--plugin", "shop/shop_csv.py")
    assert (code, "did you mean 'max_rows'" in stderr) == (2, True)
    code, _, stderr = call(*words)
    assert (code, "add --plugin PATH" in stderr) == (2, True)


# --- effects and instruments -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EFFECTS = {'a': 3}", "its reader int is not a function; expected its reader int(section)"),
        ("def f():\n    return 1\nEFFECTS = {'a': f}", "its reader f() cannot be called as its reader f(section)"),
        ("def f(a, b):\n    return 1\nINSTRUMENTS = {'a': f}", "its reader f(a, b) cannot be called"),
        ("def f(section):\n    return 1\nINSTRUMENTS = {'laser-tracer': f}", "already used by a built-in one"),
        (
            "class Gauge:\n    passes = 1\ndef f(section) -> Gauge:\n    return Gauge()\nINSTRUMENTS = {'gauge': f}",
            "Gauge.observe(stops, tip_mm, rng) is missing",
        ),
        (
            "class Gauge:\n    def observe(self, tip):\n        pass\n"
            "def f(section) -> Gauge:\n    return Gauge()\nINSTRUMENTS = {'gauge': f}",
            "Gauge has no passes",
        ),
    ],
)
def test_wrong_effects_and_instruments_are_refused(tmp_path, text, message):
    (tmp_path / "p.py").write_text(text + "\n")
    refused(tmp_path / "p.py", message)
    assert set(INSTRUMENTS) >= {"laser-tracer"}
    assert "a" not in EFFECTS


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return 5", "the effect bad is not a function"),
        ("return lambda stops: 0", "cannot be called as the effect bad(machine, stops)"),
        ("return lambda machine, stops: stops.position_mm[:, :2]", "finite numbers in mm"),
        ("return lambda machine, stops: stops.position_mm * float('nan')", "finite numbers in mm"),
    ],
)
def test_an_effect_that_returns_something_else_is_an_input_error(tmp_path, call, small_machine_file, body, message):
    (tmp_path / "p.py").write_text(f"def bad(section):\n    {body}\nEFFECTS = {{'bad': bad}}\n")
    (tmp_path / "s.toml").write_text(SCENARIO + '[[effects]]\nname = "bad"\n')
    words = ("simulate", small_machine_file, "--scenario", tmp_path / "s.toml", "--out", tmp_path / "out")
    code, _, stderr = call("--plugin", tmp_path / "p.py", *words)
    assert code == 2
    assert message in stderr
    assert not (tmp_path / "out").exists()


def test_an_instrument_of_a_plug_in_measures(tmp_path, call, small_machine_file):
    """A tracer that reads 1 um more than the built-in one."""
    (tmp_path / "p.py").write_text(
        "from dataclasses import replace\n"
        "from compgen.simulation.lasers import read_laser_tracer\n"
        "class Longer:\n"
        "    def __init__(self, inner):\n"
        "        self.inner, self.passes = inner, inner.passes\n"
        "    def observe(self, stops, tip_mm, rng):\n"
        "        readings = self.inner.observe(stops, tip_mm, rng)\n"
        "        return replace(readings, length_mm=readings.length_mm + 1e-3)\n"
        "def longer(section):\n"
        "    return Longer(read_laser_tracer(section))\n"
        "INSTRUMENTS = {'longer': longer}\n"
    )
    for kind in ("laser-tracer", "longer"):
        (tmp_path / "s.toml").write_text(SCENARIO.replace("laser-tracer", kind))
        words = ("simulate", small_machine_file, "--scenario", tmp_path / "s.toml", "--out", tmp_path / kind)
        assert call("--plugin", tmp_path / "p.py", *words)[0] == 0
    first, second = (compgen.read_lengths(tmp_path / k / "small.lengths.csv") for k in ("laser-tracer", "longer"))
    assert second.length_mm - first.length_mm == pytest.approx(np.full(len(first), 1e-3), abs=1e-9)
    assert "longer" in call("--plugin", tmp_path / "p.py", "instruments")[1]


# --- entry points ----------------------------------------------------------------------------------------------------


@pytest.fixture
def install(tutorial, tmp_path, monkeypatch):
    """Put a distribution with entry points on the path, as an installer does."""

    def make(entries, name="shop-tools"):
        folder = tmp_path / f"site-{name}"
        info = folder / f"{name.replace('-', '_')}-1.2.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(entries)
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.syspath_prepend(str(tmp_path / "shop"))

    yield make
    for module in ("shop_csv", "warm_z"):
        sys.modules.pop(module, None)


ENTRIES = "[compgen.controllers]\nshop-csv = shop_csv:ShopCsv\n[compgen.effects]\nspindle-growth = warm_z:read_growth\n"


def test_an_installed_plug_in_is_there_without_a_word(install, call, example):
    install(ENTRIES)
    code, stdout, stderr = call("controllers", "shop-csv", "--json")
    assert (code, stderr) == (0, "")
    card = json.loads(stdout)
    assert card["plugin"] == "entry point shop-csv = shop_csv:ShopCsv of shop-tools 1.2"
    assert [item["key"] for item in card["settings"]] == ["max_rows"]
    assert "spindle-growth" in call("effects")[1]


def test_a_broken_installed_plug_in_is_a_warning_and_only_its_name_is_missing(install, call, small_machine_file):
    shop(lambda text: without(text, "parse"))
    install(ENTRIES + "growth-2 = warm_z:nothing\n[compgen.instruments]\nx-ray = no_such_package:read\n")
    code, stdout, stderr = call("machines", "--json")
    assert code == 0
    assert "zha-gantry" in json.loads(stdout)
    assert stderr.count("warning: left out: ") == 3
    assert all(text in stderr for text in ("ShopCsv has no parse", "'nothing'", "no_such_package", "shop-tools 1.2"))
    assert "spindle-growth" in call("effects")[1]
    words = ("export", small_machine_file, "e.errors.csv", "--controller", "shop-csv", "--out", "out")
    Path("e.errors.csv").write_text("error,position_mm,value,u_value\nEXX,0,1,\n")
    code, _, stderr = call(*words)
    assert code == 2
    assert "there is no controller 'shop-csv'" in stderr
    assert "ShopCsv has no parse" in stderr.split("error: ")[1]


def test_an_installed_plug_in_does_not_take_a_built_in_name(install):
    install("[compgen.controllers]\nisg-csv = shop_csv:ShopCsv\n")
    built_in = CONTROLLERS["isg-csv"]
    with pytest.warns(compgen.CompgenWarning, match="already used by a built-in one"):
        load_entry_points(KINDS)
    assert controller_named("isg-csv") is built_in


def test_a_further_registry_takes_one_line(tmp_path):
    """What a later stage adds: a dict and a check."""
    shelf = Registry()
    kind = Kind("tool", "TOOLS", "compgen.tools", shelf, lambda name, thing: (thing, []))
    (tmp_path / "p.py").write_text("TOOLS = {'hammer': 1}\n")
    from compgen.registry import load_file

    load_file(tmp_path / "p.py", (*KINDS, kind))
    assert dict(shelf) == {"hammer": 1}
    assert shelf.origins == {"hammer": f"plug-in {tmp_path / 'p.py'}"}
