"""The report from a folder: its numbers against the files and against formulas, what it refuses, what it leaves out."""

import json
import re
import shutil
import tomllib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.csv_files import read_csv
from compgen.data.error_table import format_errors
from compgen.data.files import sha256_of
from compgen.drawing.charts import ROLES, Plot, svg
from compgen.errors import CompgenWarning, InputError
from compgen.pipeline import write_all
from compgen.report.html import FILES, build_report, write_report
from compgen.report.html.folder import read_folder, table_curves
from compgen.report.html.pictures import (
    VolumeOnGrid,
    describe_error,
    draw_slices,
    draw_space,
    grid_of,
    histogram,
    nice,
    projected,
    resampled,
    uncertainty_um,
)
from compgen.report.html.write import markdown, script_data
from compgen.tables import read_tables, residuals
from compgen.tables.verification import verification_files

ROUNDED_UM = 1e-3  # volume.csv has 4 decimals in um for each component
TABLE_UM = 0.01  # values of a table that were found from its field, um and urad
STYLE = Path(__file__).resolve().parents[2] / "templates" / "_report" / "style.css"


def call(*words):
    return run_command(cli, [str(word) for word in words])


@pytest.fixture(scope="module")
def ran(small_machine_file, small_lengths_file, tmp_path_factory):
    """A run for a control that holds errors by name and for one that holds corrections, with its report."""
    out = tmp_path_factory.mktemp("report") / "run"
    words = ["run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--controller", "siemens-cec"]
    assert call(*words, "--out", out) == 0
    return out


@pytest.fixture
def copy(ran, tmp_path):
    """A copy of that folder that a test may change."""
    return Path(shutil.copytree(ran, tmp_path / "copy"))


class Page(HTMLParser):
    """Texts of a page by element, and every attribute."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.texts, self.attributes, self.tags = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        self.open.append(tag)

    def handle_endtag(self, tag):
        if tag in self.open:
            while self.open.pop() != tag:
                pass

    def handle_data(self, data):
        if not {"script", "style"} & set(self.open):
            self.texts.append(data)


def test_run_writes_the_report_unless_it_is_told_not_to(ran, small_machine_file, small_lengths_file, tmp_path, capsys):
    assert set(FILES) <= {path.name for path in ran.iterdir()}
    out = tmp_path / "bare"
    words = ["run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--out", out, "--json"]
    assert call(*words, "--no-report") == 0
    assert not set(FILES) & {path.name for path in out.iterdir()}
    assert json.loads(capsys.readouterr().out)["report"] is None


def test_the_report_is_rebuilt_from_the_files_alone_byte_by_byte(ran, copy):
    for name in FILES:
        (copy / name).unlink()
    write_report(copy)
    for name in FILES:
        assert (copy / name).read_bytes() == (ran / name).read_bytes(), name


def test_report_goes_to_another_folder_and_leaves_the_first_alone(copy, listing, tmp_path, capsys):
    before = listing(copy)
    assert call("report", copy, "--out", tmp_path / "other", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert listing(copy) == before
    assert {path.name for path in (tmp_path / "other").iterdir()} == set(FILES)
    assert [item["name"] for item in printed["controls"]] == ["isg-csv", "siemens-cec"]


def test_the_numbers_are_those_of_the_files(ran):
    data = build_report(ran).data
    for item in data["controls"]:
        result = json.loads((ran / item["name"] / "result.json").read_text())
        assert item["before"] == result["before"]
        assert item["after"] == result["after"]
        assert item["after_rigid"] == result["after_rigid_motion_removed"]
        for file in item["files"]:
            assert file["sha256"] == sha256_of((ran / item["name"] / file["name"]).read_bytes())
            assert file["intact"] is True
    errors = compgen.read_errors(ran / "identified.errors.csv")
    rows = {row["error"]: row for row in data["errors"]}
    assert tuple(rows) == errors.names
    assert rows["EC0Y"]["largest"] == pytest.approx(errors.squareness["EC0Y"][0] * 1e6, rel=1e-12)
    assert rows["EBX"]["U"] == pytest.approx(2.0 * errors.curves["EBX"].u.max() * 1e6, rel=1e-12)
    assert rows["EXX"]["value"] == pytest.approx((errors.curves["EXX"].value * 1e3).tolist(), rel=1e-12)


def test_volume_file_holds_the_points_behind_the_figures(ran):
    """max, rms, p95, V_X ... of result.json come out of volume.csv again, so the pictures show what the figures say."""
    for name in ("isg-csv", "siemens-cec"):
        result = json.loads((ran / name / "result.json").read_text())
        columns = [f"{when}_{axis}_um" for when in ("before", "after") for axis in "xyz"]
        table = read_csv(ran / name / "volume.csv", ["x_mm", "y_mm", "z_mm", *columns])
        assert len(table) == result["points"]
        for when in ("before", "after"):
            error_mm = np.column_stack([table.numbers(f"{when}_{axis}_um") for axis in "xyz"]) * 1e-3
            for key, value in residuals(error_mm).as_dict().items():
                assert value == pytest.approx(result[when][key], abs=ROUNDED_UM), (name, when, key)


def test_residuals_file_has_the_rms_that_identify_states(ran):
    table = read_csv(ran / "residuals.csv", ["station", "x_mm", "y_mm", "z_mm", "residual_um", "used"])
    stated = json.loads((ran / "identify.json").read_text())
    used = table.numbers("used") > 0.5
    assert used.sum() == stated["readings_used"]
    assert np.sqrt(np.mean(table.numbers("residual_um")[used] ** 2)) == pytest.approx(
        stated["residual_rms_um"], abs=1e-4
    )


def test_residuals_are_measurement_minus_model(small_machine, small_lengths_file):
    """The largest one lies where the reading was made 40 um longer, with a plus sign."""
    from dataclasses import replace

    from compgen.identification.any_measurement import format_residuals

    lengths = compgen.read_lengths(small_lengths_file)
    reading = lengths.length_mm.copy()
    reading[123] += 0.040
    changed = replace(lengths, length_mm=reading)
    with pytest.warns(CompgenWarning, match="does not describe the readings"):
        found = compgen.identify(small_machine, changed, compgen.IdentifyOptions(reject=False))
    lines = [line for line in format_residuals(small_machine, changed, found).splitlines() if not line.startswith("#")]
    values = np.array([float(line.split(",")[4]) for line in lines[1:]])
    assert int(np.argmax(np.abs(values))) == 123
    assert values[123] == pytest.approx(40.0, abs=3.0)  # a little of it goes into the curves


def values_in_text(text):
    """Columns of the blocks of an ISG_CSV file by name, read here without compgen: (positions in mm, values)."""
    found, head = {}, None
    for line in text.splitlines():
        words = line.split()
        if not words or line.startswith(("//", "#")):
            head = None
        elif head is None:
            head, rows = words, []
        else:
            rows.append([float(word) for word in words])
            columns = list(zip(*rows, strict=True))
            found |= {name: (columns[0], column) for name, column in zip(head, columns, strict=True)}
    return found


def test_table_values_on_the_curves_are_those_in_the_file(ran):
    """isg-csv holds errors by name in mm and rad."""
    source = read_folder(ran)
    (control,) = (item for item in source.controls if item.name == "isg-csv")
    curves = {item.name: item for item in table_curves(source.fitted, control)}
    assert set(curves) == set(source.fitted.names)
    assert all(item.error for item in curves.values())
    written = values_in_text((ran / "isg-csv" / "volcomp0.csv").read_text())
    checked = 0
    for name, item in curves.items():
        if item.axis is not None:
            position_mm, value = written[name]
            scale = {"um": 1e3, "urad": 1e6}[item.unit]
            assert item.position_mm == pytest.approx(position_mm)
            assert item.value == pytest.approx(np.array(value) * scale, abs=TABLE_UM), name
            checked += 1
    assert checked == 14


def test_tables_written_in_their_basis_give_back_what_the_control_adds(ran):
    """Independent of the projection: the terms' sum is evaluated here with numpy.interp and compared at random points."""
    source = read_folder(ran)
    (control,) = (item for item in source.controls if item.name == "siemens-cec")
    curves = table_curves(source.fitted, control)
    parsed = read_tables(source.machine, [item.path for item in control.files], "siemens-cec")
    basis = {t.name: t for t in parsed.controller.basis_of(source.fitted, parsed.tables)}
    generator = np.random.default_rng(8)
    points = generator.uniform(source.machine.lower_mm, source.machine.upper_mm, (300, 3))
    tool = np.array(source.machine.tool_offset_mm)
    total = np.zeros((300, 3))
    for item in curves:
        along = points[:, "XYZ".index(item.axis)]
        value = np.interp(along, item.position_mm, item.value) * (1e-6 if item.unit == "urad" else 1e-3)
        total += basis[item.name].carrier_field(points, tool) * value[:, None]
    added = parsed.correction(source.machine, compgen.Points(points))
    assert np.max(np.abs(total - added)) < 1e-4  # 0.1 um: products of two tables act beside their parts


def test_a_table_that_was_changed_afterwards_is_pointed_out(copy):
    path = copy / "isg-csv" / "volcomp0.csv"
    path.write_bytes(path.read_bytes() + b"\n")
    with pytest.warns(CompgenWarning, match="is not the file that was verified"):
        report = build_report(copy)
    assert "not the verified file" in report.files["report.html"]
    assert any("its verdict does not apply" in text for text in report.data["limitations"])


def test_rejected_tables_come_with_the_reasons_first(copy):
    path = copy / "isg-csv" / "result.json"
    result = json.loads(path.read_text())
    path.write_text(json.dumps({**result, "accepted": False, "reasons": ["the sign is reversed"]}))
    report = build_report(copy)
    assert report.data["verdict"]["state"] == "rejected"
    assert [item["name"] for item in report.data["controls"]] == ["siemens-cec", "isg-csv"]
    texts = Page(report.files["report.html"]).texts
    assert "the sign is reversed" in texts


@pytest.mark.parametrize("kind", ["identify", "verify", "compare", "accuracy"])
def test_other_commands_folders_get_a_report_too(kind, ran, small_machine_file, small_lengths_file, tmp_path, capsys):
    errors, out = ran / "identified.errors.csv", tmp_path / "out"
    files = (ran / "isg-csv" / "volcomp0.csv", ran / "isg-csv" / "volcomp0.lis")
    words = {
        "identify": ("identify", small_machine_file, small_lengths_file),
        "verify": ("verify", small_machine_file, *files, "--controller", "isg-csv", "--errors", errors),
        "compare": ("compare", small_machine_file, errors, ran / "fitted.errors.csv"),
        "accuracy": ("accuracy", small_machine_file, errors),
    }[kind]
    assert call(*words, "--out", out) in (0, 1)
    capsys.readouterr()
    assert call("report", out) == 0
    assert "report.html" in capsys.readouterr().out
    data = json.loads((out / "report.json").read_text())
    assert data["kind"] == kind
    page = (out / "report.html").read_text()
    expected = {"identify": "figure-curve-EXX", "verify": "figure-space-0", "compare": "decided by", "accuracy": "V_X"}[
        kind
    ]
    assert expected.lower() in page.lower()


def test_iso_figures_are_those_of_the_accuracy_stage(ran, small_machine_file, tmp_path, capsys):
    out = tmp_path / "accuracy"
    assert call("accuracy", small_machine_file, ran / "identified.errors.csv", "--out", out) == 0
    stated = json.loads((out / "accuracy.json").read_text())["figures"]
    groups = build_report(ran).data["accuracy"]["groups"]
    rows = {row["key"]: row["value"] for group in groups for row in group["rows"]}
    for group in ("volume", "orientation", "axes", "diagonals"):
        for key, item in stated[group].items():
            assert rows[key] == pytest.approx(item["value"], rel=1e-9), key


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such folder"),
        ({}, "contains none of result.json"),
        ({"result.json": "{"}, "is not JSON"),
        ({"result.json": "[1]"}, "does not contain a JSON object"),
        ({"identify.json": "{}", "identified.errors.csv": "error,position_mm\nEXX,0\n"}, "column 'value' is missing"),
        ({"identify.json": "{}", "residuals.csv": "residual_um,used\n1,x\n"}, "is not a number"),
        ({"identify.json": b"\xff\xfe{"}, "is not JSON"),
    ],
)
def test_what_is_no_result_folder_is_refused(content, message, tmp_path, capsys):
    folder = tmp_path / "folder"
    if content is not None:
        folder.mkdir()
        for name, text in content.items():
            (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=re.escape(message)):
        build_report(folder)
    assert call("report", folder) == 2
    assert message in capsys.readouterr().err
    assert not (folder / "report.html").exists()


def test_a_path_out_of_the_folder_is_not_followed(copy, tmp_path):
    (tmp_path / "secret.txt").write_text("secret words")
    path = copy / "isg-csv" / "result.json"
    result = json.loads(path.read_text())
    result["files"] = [{"name": "../../secret.txt", "sha256": "0"}, {"name": str(tmp_path / "secret.txt")}, 5]
    path.write_text(json.dumps(result))
    assert "secret words" not in build_report(copy).files["report.html"]


def test_a_machine_file_that_does_not_fit_any_more_leaves_the_numbers(copy):
    (copy / "machine.toml").write_text("name = 5\n")
    report = build_report(copy)
    assert [note.partition(":")[0] for note in report.data["notes"]] == ["machine.toml cannot be used"]
    assert "figure-curve-EXX" in report.files["report.html"]


def test_the_page_names_no_address_and_loads_nothing(ran):
    page = Page((ran / "report.html").read_text())
    loads = [(name, value) for name, value in page.attributes if name in ("src", "srcset", "action", "data", "poster")]
    assert loads == []
    links = [value for name, value in page.attributes if name in ("href", "xlink:href")]
    assert links
    assert all(value.startswith(("#", "data:image/png;base64,")) for value in links)
    assert "url(http" not in STYLE.read_text()
    assert "@import" not in STYLE.read_text()


def test_every_colour_of_a_picture_is_named_in_both_palettes(ran):
    style = STYLE.read_text()
    light, dark = (set(re.findall(r"--([a-z0-9-]+):", part)) for part in style.split("@media screen", 1))
    assert set(ROLES) <= light
    assert set(ROLES) <= dark
    page = (ran / "report.html").read_text()
    assert set(re.findall(r"(?:stroke|fill):var\(--([a-z0-9]+)\)", page[page.index("<body>") :])) <= set(ROLES)


def test_ids_of_two_pictures_differ_and_user_texts_in_titles_are_escaped():
    pictures = []
    for key in ("a", "b"):
        plot = Plot((0.0, 1.0), (0.0, 1.0), title="<i>", x_label="<b>", x_ticks=[(0.5, "<u>")])
        plot.line([0, 1], [1, 0], "line")
        plot.text(0.5, 0.5, "<s>")
        pictures.append(svg(key, "<b>&", [plot]))
    ids = [set(re.findall(r'\bid="([^"]+)"', text)) for text in pictures]
    assert ids[0]
    assert not ids[0] & ids[1]
    assert "&lt;b&gt;&amp;" in pictures[0]
    assert not re.search("<[bius]>", pictures[0])
    assert "var(--line)" in pictures[0]


def test_data_in_a_script_element_cannot_end_it():
    text = str(script_data({"a": "</script><!--<script>\u2028\u2029&", "b": [1.5, None]}))
    assert not set("<>&\u2028\u2029") & set(text)
    assert json.loads(text) == {"a": "</script><!--<script>\u2028\u2029&", "b": [1.5, None]}


@pytest.mark.parametrize(
    "text",
    ["<img src=x onerror=a()>", "[x](javascript:a())", "![x](http://x/y.png)", "<http://x>", "[x]: http://x\n\n[x]"],
)
def test_markdown_makes_no_element_that_acts(text):
    tags = {"p", "li", "ul", "code"}
    assert set(Page(str(markdown(text))).tags) <= tags


def test_markdown_keeps_headings_lists_tables_and_code():
    html = str(markdown("# A\n\n- [ ] do `x`\n\n| a | b |\n|---|---|\n| 1 | 2 |\n"))
    assert "<h4>A</h4>" in html
    assert "class='check'>do <code>x</code>" in html
    assert "<td>2</td>" in html


def test_names_of_errors_in_words():
    words = {name: describe_error(name) for name in ("EXX", "EYX", "EAX", "EBX", "ECY", "EBY", "EC0Y", "EA0Z")}
    assert words == {
        "EXX": "Positioning of X",
        "EYX": "Straightness of X in Y",
        "EAX": "Roll of X",
        "EBX": "Rotation of X about Y",
        "ECY": "Rotation of Y about Z",
        "EBY": "Roll of Y",
        "EC0Y": "Squareness of Y to X",
        "EA0Z": "Squareness of Z to Y",
    }


def test_grid_takes_the_mean_of_both_directions_and_refuses_scattered_points(ran):
    volume = read_folder(ran).controls[0].volume
    grid = grid_of(volume)
    assert np.prod([len(level) for level in grid.levels_mm]) == len(volume.position_mm)
    place = (2, 1, 3)
    point = np.array([level[k] for level, k in zip(grid.levels_mm, place, strict=True)])
    row = int(np.argmin(np.linalg.norm(volume.position_mm - point, axis=1)))
    assert grid.before_mm[place] == pytest.approx(volume.before_mm[row])
    twice = type(volume)(
        np.vstack([volume.position_mm] * 2),
        np.vstack([volume.before_mm + 0.002, volume.before_mm - 0.004]),
        np.vstack([volume.after_mm] * 2),
    )
    assert grid_of(twice).before_mm == pytest.approx(grid.before_mm - 0.001)
    places = [level[[0, 1]].mean(keepdims=True) for level in grid.levels_mm]
    for found, field_mm in zip(resampled(grid, places), (grid.before_mm, grid.after_mm), strict=True):
        corners = field_mm[:2, :2, :2].reshape(8, 3)  # the middle of a cell: linear interpolation is their mean
        assert found.ravel() == pytest.approx(corners.mean(axis=0))
    scattered = type(volume)(volume.position_mm[:-1], volume.before_mm[:-1], volume.after_mm[:-1])
    assert grid_of(scattered) is None


def test_cells_that_controls_share_are_on_the_page_once_and_are_those_of_each(ran):
    text = (ran / "report.html").read_text()
    items = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])
    shared = {key: item["values"] for key, item in items.items() if isinstance(item.get("values"), str)}
    assert shared == {f"slice-1-before-{axis}": f"slice-0-before-{axis}" for axis in range(3)}
    control = read_folder(ran).controls[1]
    own = draw_slices(grid_of(control.volume, uncertainty_um(control.result)), 1, {})
    for picture in own:
        assert picture.data["values"] == items[shared.get(picture.key, picture.key)]["values"]


def test_projection_shows_z_upright_and_histograms_count_every_value():
    up = projected(np.array([0.0, 0.0, 1.0])) - projected(np.zeros(3))
    assert up[0] == 0.0
    assert up[1] > 0.5
    values = np.array([-1.0, -0.2, 0.0, 0.1, 1.0])
    edges, counts = histogram(values, 1.0)
    assert counts.sum() == len(values)
    assert edges[0] == -1.0
    assert nice(0.0471) == pytest.approx(0.02)


def test_dossier_names_measurement_model_tables_verification_and_limits(ran):
    text = (ran / "dossier.md").read_text()
    for title in ("Machine and model", "What was measured", "Identification", "Tables", "Verification", "Limits"):
        assert re.search(rf"^## \d\. {title}$", text, re.MULTILINE), title
    inputs = json.loads((ran / "dossier.json").read_text())["measured"]["inputs"]
    assert [item["name"] for item in inputs] == ["small-gantry.toml", "small.lengths.csv"]
    assert all(item["sha256"] in text for item in inputs)
    assert "WFYXZT" in text


def test_calibration_record_has_units_and_expanded_uncertainties(ran):
    record = json.loads((ran / "calibration.json").read_text())
    assert "not a DCC" in record["statement"]
    errors = compgen.read_errors(ran / "identified.errors.csv")
    results = {item["name"]: item for item in record["measurementResults"][0]["results"]}
    curve, values = errors.curves["EAX"], results["EAX"]["values"]
    assert values["unitXMLList"] == ["\\micro\\radian"]
    assert values["valueXMLList"] == pytest.approx((curve.value * 1e6).tolist())
    assert values["expandedUncXMLList"]["uncertaintyXMLList"] == pytest.approx((2e6 * curve.u).tolist())
    assert values["expandedUncXMLList"]["coverageFactor"] == 2.0
    assert results["EAX"]["positions"]["unitXMLList"] == ["\\milli\\metre"]
    assert results["EXX"]["values"]["unitXMLList"] == ["\\micro\\metre"]


def test_the_machine_file_is_kept_byte_by_byte(ran, small_machine_file):
    assert (ran / "machine.toml").read_bytes() == small_machine_file.read_bytes()
    assert tomllib.loads((ran / "machine.toml").read_text())["name"] == "small-gantry"


def test_a_run_on_hostile_labels_comments_and_headers_gives_an_inert_page(
    small_machine_file, small_lengths_file, tmp_path, capsys
):
    """The same elements and attributes as without them: texts of files add text to the page, and nothing else."""
    evil = "<img src=x onerror=a()></script><script>a()</script>"
    name = evil.replace("=", ":")  # names with "=" are refused
    machine = tmp_path / "evil.toml"
    machine.write_text(small_machine_file.read_text().replace("small-gantry", name))
    lines = small_lengths_file.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    station = lines[head].split(",").index("station")
    rows = [line.split(",") for line in lines[head + 1 :]]
    for row in rows:
        row[station] = f'"{name} {row[station]}"'
    text = [*lines[:head], f"# date = {evil}", f"{lines[head]},{evil}", *(",".join([*row, "1"]) for row in rows)]
    measured = tmp_path / "evil.lengths.csv"
    measured.write_text("\n".join(text) + "\n")
    out = tmp_path / "out"
    assert call("run", machine, measured, "--controller", "isg-csv", "--out", out) == 0
    assert "is unknown and ignored" in capsys.readouterr().err
    plain = tmp_path / "plain"
    assert call("run", small_machine_file, small_lengths_file, "--controller", "isg-csv", "--out", plain) == 0
    found, usual = (Page((folder / "report.html").read_text()) for folder in (out, plain))
    assert evil in "".join(found.texts) and name in "".join(found.texts)
    assert {tag: found.tags.count(tag) for tag in ("script", "img", "iframe", "style", "a", "svg", "th")} == {
        tag: usual.tags.count(tag) for tag in ("script", "img", "iframe", "style", "a", "svg", "th")
    }
    assert not [name for name, _ in found.attributes if name.startswith("on")]
    assert not re.search(r"(?<!\\)<", (out / "dossier.md").read_text())


def test_the_report_of_a_verification_is_called_after_the_machine_not_after_the_folder(
    small_machine, small_errors, tmp_path
):
    written = compgen.export(small_machine, small_errors, "isg-csv").write(tmp_path / "tables")
    result = compgen.verify(small_machine, compgen.read_tables(small_machine, written, "isg-csv"), small_errors)
    write_all(tmp_path / "check", verification_files(result))
    assert build_report(tmp_path / "check").data["title"] == "small-gantry"


def test_a_date_that_nobody_filled_in_is_not_a_date(small_machine, small_errors, tmp_path):
    text = format_errors(small_errors, {"date": ""})
    assert "# date = \n" in text
    write_all(tmp_path, {"identified.errors.csv": text, "identify.json": "{}"})
    assert build_report(tmp_path).data["provenance"]["date"] is None


def test_no_picture_of_the_volume_is_enlarged_beyond_what_is_known():
    """After compensation 0.002 um is left of what was measured, and U = 6 um of what was not: nothing finer is drawn."""
    levels = tuple(np.linspace(0.0, 100.0, 3) for _ in range(3))
    before, after = np.full((3, 3, 3, 3), 0.02), np.full((3, 3, 3, 3), 2e-6)
    plain, known = (VolumeOnGrid(levels, before, after, u_um) for u_um in (None, 6.0))
    spaces = [draw_space(grid, 0).data for grid in (plain, known)]
    assert spaces[0]["before_scale"] == spaces[1]["before_scale"]
    assert spaces[0]["after_scale"] > 1e5
    assert spaces[1]["after_scale"] == pytest.approx(nice(0.1 * 100.0 / 6e-3))
    drawn = [item for item in draw_slices(known, 0, {}) if item.title == "After"]
    assert all("U 6.00 µm" in item.note and "<0.1 µm" in item.note and "0.002" not in str(item.data) for item in drawn)
    assert uncertainty_um({"after_uncertainty": {"U_max_um": 6.0}}) == 6.0
    assert uncertainty_um({"after_uncertainty": None}) is None
