"""Prints of measuring machines, probe logs, DMIS and QIF in the manner of shops, written from a hidden truth of the model."""

import functools
import re
import warnings

import numpy as np
import pytest

import compgen
from compgen.data.deviations import read_artefacts, read_parts
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, import_file, open_measurement
from compgen.identification.any_measurement import identify_measurement

ORIGIN = (-700.0, -900.0, -250.0)
GRID = np.array([[x, y, 0.0] for x in range(0, 601, 100) for y in range(0, 801, 100)], dtype=float)
NAMES = [f"H{k + 1}" for k in range(len(GRID))]
PART = ImportOptions(kind="part", origin="-700,-900,-250")


@functools.cache
def truth():
    """Machine, errors, and where the tip is when the machine drills the holes of GRID, in coordinates of the part."""
    machine = compgen.load_machine("zha-gantry")
    x, y = (np.linspace(*axis.range_mm, 9) for axis in machine.axes[:2])
    none = np.full(9, np.nan)
    curves = {
        "EXX": compgen.Curve(x, 30e-6 * x, none),
        "EYX": compgen.Curve(x, 4e-3 * np.sin(np.pi * x / 800), none),
        "EYY": compgen.Curve(y, -20e-6 * y, none),
    }
    errors = compgen.ErrorTable(curves, {"EC0Y": (40e-6, float("nan"))})
    place = GRID + ORIGIN
    return machine, errors, GRID + compgen.predict(machine, errors, compgen.Points(place), exact=True)


def printed(turn_rad=2e-4, shift=(0.012, -0.03, 0.0)):
    """Measured coordinates as the measuring machine prints them: the pose of its alignment is its own."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return truth()[2] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + shift


def rows(line, decimal=".", measured=None):
    text = []
    for name, n, a in zip(NAMES, GRID, printed() if measured is None else measured, strict=True):
        values = {
            f"{role}{axis}": f"{v[k]:.4f}"
            for role, v in (("n", n), ("a", a), ("d", a - n))
            for k, axis in enumerate("xyz")
        }
        text.append(line.format(name=name, **{key: v.replace(".", decimal) for key, v in values.items()}))
    return "\n".join(text) + "\n"


PRINTS = {
    "blanks": "CMM report  part 4711\nAlignment: G54 X-700 Y-900 Z-250\nUnits: mm\n\n"
    "Feature  Nom X  Nom Y  Act X  Act Y  Dev X  Dev Y\n" + rows("{name}  {nx}  {ny}  {ax}  {ay}  {dx}  {dy}"),
    "german": "Prüfprotokoll;Platte 12\nNullpunkt G54: X -700,000 Y -900,000 Z -250,000\n"
    "Bohrung;X Soll [mm];X Ist [mm];Y Soll [mm];Y Ist [mm];Abw X [mm];Abw Y [mm]\n"
    + rows("{name};{nx};{ax};{ny};{ay};{dx};{dy}", ","),
    "um deviations only": "Label\tX nominal (mm)\tY nominal (mm)\tX dev (mm)\tY dev (mm)\n"
    + rows("{name}\t{nx}\t{ny}\t{dx}\t{dy}"),
    "groups of roles": ";Nominal;;Measured;;Deviation;\nFeature;X;Y;X;Y;X;Y\n"
    + rows("{name};{nx};{ny};{ax};{ay};{dx};{dy}"),
    "groups of axes": ",X,,,Y,,\nFeature,Nominal,Measured,Deviation,Nominal,Measured,Deviation\n"
    + rows("{name},{nx},{ax},{dx},{ny},{ay},{dy}"),
    "long": "Feature;Axis;Nominal;Measured;Deviation;+Tol;-Tol\n"
    + rows("{name};X;{nx};{ax};{dx};0.1;-0.1\n{name};Y;{ny};{ay};{dy};0.1;-0.1\n{name};D;8;8.01;0.01;0.1;-0.1"),
    "blocks of dimensions": "PART NAME : PLATE\n"
    + rows(
        "DIM L_{name}= LOCATION OF CIRCLE {name} UNITS=MM\nAX NOMINAL +TOL -TOL MEAS DEV OUTTOL\nX {nx} 0.1 -0.1 {ax} {dx} 0.0\n"
        "Y {ny} 0.1 -0.1 {ay} {dy} 0.0"
    ),
    "names with the axis": "Name\tSollwert\tMesswert\tAbweichung\n"
    + rows("{name}.X\t{nx}\t{ax}\t{dx}\n{name}.Y\t{ny}\t{ay}\t{dy}", ","),
    "french": "Point;X théorique;Y théorique;X mesuré;Y mesuré\n" + rows("{name};{nx};{ny};{ax};{ay}", ","),
    "dmis": "DMISMN/'PLATE'\nUNITS/MM,ANGDEC\n"
    + rows(
        "F({name})=FEAT/CIRCLE,INNER,CART,{nx},{ny},{nz},0,0,1,8.0\nFA({name})=FEAT/CIRCLE,INNER,CART,{ax},{ay},{az},0,0,1,8.01"
    ),
}


def squareness_urad(data):
    machine = compgen.load_machine("zha-gantry")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        return 1e6 * identify_measurement(machine, data).errors.squareness["EC0Y"][0]


@pytest.mark.parametrize("name", PRINTS)
def test_a_part_is_read_from_every_form_of_print_with_the_signs_of_the_hidden_truth(tmp_path, name):
    path = tmp_path / "cmm.txt"
    path.write_text(PRINTS[name], encoding="utf-8")
    asked = import_file(path, ImportOptions())
    assert any("--kind part" in doubt for doubt in asked.doubts)
    stated = "G54" in PRINTS[name]
    assert any("--origin" in doubt for doubt in asked.doubts) == (not stated)
    item = import_file(path, ImportOptions(kind="part") if stated else PART)
    assert (item.kind, item.doubts) == ("part", ())
    assert list(item.data.feature) == NAMES
    native = tmp_path / item.file_name
    native.write_text(item.files()[item.file_name])
    parts = read_parts(native)
    expected = truth()[2] - GRID
    away = parts.deviation_mm - expected
    # equal up to a shift and a small rotation, as far as the print has digits
    flat = np.column_stack([np.ones(len(GRID)), GRID[:, :2] - GRID[:, :2].mean(axis=0)])
    for k in (0, 1):
        fitted = np.linalg.lstsq(flat, away[:, k], rcond=None)[0]
        assert np.abs(away[:, k] - flat @ fitted).max() < 1.1e-4
    assert np.array_equal(parts.position_mm, GRID + ORIGIN)
    with pytest.warns(CompgenWarning):
        assert np.allclose(
            np.nan_to_num(
                open_measurement([path], answers=ImportOptions(kind="part") if stated else PART).deviation_mm
            ),
            np.nan_to_num(parts.deviation_mm),
        )


def test_the_squareness_of_the_hidden_truth_comes_out_of_a_german_print(tmp_path):
    path = tmp_path / "cmm.txt"
    path.write_text(PRINTS["german"], encoding="cp1252")
    with pytest.warns(CompgenWarning):
        data = open_measurement([path], answers=ImportOptions(kind="part"))
    assert squareness_urad(data) == pytest.approx(40.0, abs=8.0)


def probed():
    """Machine coordinates at which the probe finds a true grid: the machine goes where its error brings the tip to the place."""
    machine, errors, _ = truth()
    place = GRID + ORIGIN
    at = place.copy()
    for _ in range(5):
        at = place - compgen.predict(machine, errors, compgen.Points(at), exact=True)
    return at


def test_an_artefact_has_the_opposite_sign_and_asks_for_its_calibration(tmp_path):
    path = tmp_path / "kugelplatte.csv"
    lines = rows("{name};{nx};{ny};{ax};{ay}", ",", probed())
    path.write_text("Kugel;X Soll;Y Soll;X Ist;Y Ist\n" + lines, encoding="utf-8")
    asked = import_file(path, ImportOptions(kind="artefact", origin="0,0,0"))
    assert [doubt for doubt in asked.doubts if "--calibrated" in doubt] == list(asked.doubts)
    item = import_file(path, ImportOptions(kind="artefact", origin="0,0,0", calibrated="yes"))
    assert item.doubts == ()
    native = tmp_path / item.file_name
    native.write_text(item.files()[item.file_name])
    assert squareness_urad(read_artefacts(native)) == pytest.approx(40.0, abs=8.0)


def test_a_column_of_calibrated_values_says_that_it_is_a_calibrated_artefact(tmp_path):
    path = tmp_path / "plate.csv"
    path.write_text("Ball;Cal X;Cal Y;Meas X;Meas Y\n" + rows("{name};{nx};{ny};{ax};{ay}"), encoding="utf-8")
    item = import_file(path, ImportOptions(origin="0,0,0"))
    assert (item.kind, item.doubts) == ("artefact", ())
    assert item.data.calibrated.all()


TABLE = "Feature;X nom;Y nom;X act;Y act\n" + rows("{name};{nx};{ny};{ax};{ay}")


@pytest.mark.parametrize("between", ["\n", "Page 2\n"])
def test_repeated_headers_are_one_or_several_set_ups_and_that_is_asked(tmp_path, between):
    path = tmp_path / "two.csv"
    path.write_text(TABLE + between + TABLE, encoding="utf-8")
    (doubt,) = import_file(path, PART).doubts
    assert "--clamping" in doubt
    counts = [
        len(set(import_file(path, ImportOptions(kind="part", origin="0,0,0", clamping=way)).data.setup))
        for way in ("one", "each")
    ]
    assert counts == [1, 2]


@pytest.mark.parametrize(
    "heading", ["Setup 1|Setup 2", "Aufspannung: 1|Aufspannung: 2", "G54 X-700 Y-900 Z-250|G55 X-650 Y-900 Z-250"]
)
def test_lines_that_number_set_ups_or_state_their_zeros_are_used(tmp_path, heading):
    first, second = heading.split("|")
    path = tmp_path / "two.csv"
    path.write_text(f"{first}\n{TABLE}{second}\n{TABLE}", encoding="utf-8")
    item = import_file(path, ImportOptions(kind="part") if "G54" in heading else PART)
    assert item.doubts == ()
    assert sorted(set(item.data.setup)) == [1, 2]
    if "G54" in heading:
        shift = item.data.position_mm[len(GRID)] - item.data.position_mm[0]
        assert shift.tolist() == [50.0, 0.0, 0.0]
        assert np.allclose(
            item.data.deviations().deviation_mm[:3, :2], item.data.deviations().deviation_mm[len(GRID) :][:3, :2]
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace(text.split(";")[7], "n/a", 1), "n/a"),
        (lambda text: text.replace("Y act", "Gizmo"), "Gizmo|other coordinates"),
        (lambda text: text + "H99;1;2;3\n", "is empty"),
        (lambda text: text.replace("H3;0.0000;200.0000", "H3;0.0000;2.0000"), "H3"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path, change, message):
    path = tmp_path / "cmm.csv"
    path.write_text(change(TABLE), encoding="utf-8")
    try:
        doubts = " ".join(import_file(path, PART).doubts)
    except InputError as error:
        doubts = str(error)
        assert error.line or error.field
    assert any(word in doubts for word in message.split("|"))


def test_printed_deviations_of_the_other_sign_are_asked(tmp_path):
    path = tmp_path / "cmm.csv"
    head = "Feature;X nom;Y nom;X act;Y act;X dev;Y dev\n"
    turned = rows("{name};{nx};{ny};{ax};{ay};{dx};{dy}")
    lines = []
    for line in turned.splitlines():
        cells = line.split(";")
        lines.append(";".join([*cells[:5], f"{-float(cells[5]):.4f}", f"{-float(cells[6]):.4f}"]))
    path.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    (doubt,) = import_file(path, PART).doubts
    assert "opposite sign" in doubt
    assert import_file(path, ImportOptions(kind="part", origin="0,0,0", ignore=("X dev", "Y dev"))).doubts == ()


def qif(features, factor=0.001):
    """A QIF document with features (name, nominal, measured), structured as ISO 23952 describes it."""
    nominal, items, actual = [], [], []
    for k, (name, one, other) in enumerate(features):
        place = [" ".join(f"{v:.6f}" for v in values) for values in (one, other)]
        nominal.append(f'<CircleFeatureNominal id="{100 + k}"><Location>{place[0]}</Location></CircleFeatureNominal>')
        items.append(
            f'<CircleFeatureItem id="{300 + k}"><FeatureNominalId>{100 + k}</FeatureNominalId><FeatureName>{name}</FeatureName>'
            "</CircleFeatureItem>"
        )
        actual.append(
            f'<CircleFeatureActual id="{500 + k}"><FeatureItemId>{300 + k}</FeatureItemId><Location>{place[1]}</Location>'
            "</CircleFeatureActual>"
        )
    return (
        '<?xml version="1.0"?><QIFDocument xmlns="http://qifstandards.org/xsd/qif2"><FileUnits><PrimaryUnits><LinearUnit>'
        f"<SIUnitName>meter</SIUnitName><UnitName>mm</UnitName><UnitConversion><Factor>{factor}</Factor></UnitConversion>"
        f"</LinearUnit></PrimaryUnits></FileUnits><Features>{''.join(nominal)}{''.join(items)}</Features>"
        f"<MeasurementsResults>{''.join(actual)}</MeasurementsResults></QIFDocument>"
    )


@pytest.mark.parametrize(("factor", "unit_mm"), [(0.001, 1.0), (0.0254, 25.4)])
def test_qif_results_in_millimetres_and_inches(tmp_path, factor, unit_mm):
    path = tmp_path / "results.qif"
    path.write_text(
        qif([(n, g / unit_mm, a / unit_mm) for n, g, a in zip(NAMES, GRID, printed(), strict=True)], factor)
    )
    item = import_file(path, PART)
    assert (item.format, item.kind, item.doubts) == ("qif", "part", ())
    assert np.allclose(item.data.measured_mm, printed(), atol=1e-4)
    assert list(item.data.feature) == NAMES


def test_a_qif_document_whose_nominal_is_elsewhere_or_that_is_cut_is_refused(tmp_path):
    path = tmp_path / "results.qif"
    text = qif([(n, g, a + 500.0 * (n == "H7")) for n, g, a in zip(NAMES, GRID, printed(), strict=True)])
    path.write_text(text)
    with pytest.raises(InputError, match="'H7'.*--ignore"):
        import_file(path, PART)
    assert len(import_file(path, ImportOptions(kind="part", origin="0,0,0", ignore=("H7",))).data) == len(GRID) - 1
    path.write_text(text[: len(text) // 2])
    with pytest.raises(InputError, match="complete XML"):
        import_file(path, PART)


def test_several_measurements_in_a_qif_document_can_be_set_ups_of_their_own(tmp_path):
    """Six samples of one part: each was clamped by itself."""
    path = tmp_path / "results.qif"
    text = qif([(n, g, a) for n, g, a in zip(NAMES, GRID, printed(), strict=True)])
    begin, end = text.index("<MeasurementsResults>") + 21, text.index("</MeasurementsResults>")
    one = f"<MeasurementResults>{text[begin:end]}</MeasurementResults>"
    path.write_text(text[:begin] + one + one + text[end:])
    assert "2 tables" in " ".join(import_file(path, PART).doubts)
    each = import_file(path, ImportOptions(kind="part", origin="0,0,0", clamping="each"))
    assert sorted(each.data.setup.tolist()) == [1] * len(GRID) + [2] * len(GRID)


@pytest.mark.parametrize("form", ["qif", "dmis"])
def test_planes_and_points_that_were_probed_along_an_axis_are_not_places(form, tmp_path):
    """Their other coordinates are where the machine was sent: as errors of zero they would pull the result to nothing."""
    beside = {"A": ("Plane", [9.0, 3.0, 0.0], [2.0, 1.0, 0.01]), "B": ("Point", [9.0, 3.0, 0.0], [9.0, 3.0, 0.02])}
    path = tmp_path / "results.txt"
    if form == "qif":
        every = [(n, g, a) for n, g, a in zip(NAMES, GRID, printed(), strict=True)]
        text = qif([*every, *((name, one, other) for name, (_, one, other) in beside.items())])
        for k, (kind, _, _) in enumerate(beside.values(), len(every)):
            text = re.sub(
                rf'<Circle(Feature\w+) id="([135]){k:02d}">(.*?)</Circle',
                rf'<{kind}\1 id="\g<2>{k:02d}">\3</{kind}',
                text,
            )
    else:
        text = PRINTS["dmis"]
        for name, (kind, one, other) in beside.items():
            for role, place in (("F", one), ("FA", other)):
                text += f"{role}({name})=FEAT/{kind.upper()},CART,{place[0]},{place[1]},{place[2]},0,0,1\n"
    path.write_text(text)
    item = import_file(path, PART)
    assert list(item.data.feature) == NAMES
    assert "'A' (plane) has no place of its own" in " ".join(item.notes)
    assert "'B' was probed along one axis" in " ".join(item.notes)


def test_a_qif_document_whose_features_are_in_another_one_says_so(tmp_path):
    path = tmp_path / "results.qif"
    path.write_text(
        '<QIFDocument xmlns="http://qifstandards.org/xsd/qif3"><FileUnits><PrimaryUnits><LinearUnit><SIUnitName>meter</SIUnitName>'
        "<UnitName>mm</UnitName><UnitConversion><Factor>0.001</Factor></UnitConversion></LinearUnit></PrimaryUnits></FileUnits>"
        "<ExternalQIFReferences/></QIFDocument>"
    )
    with pytest.raises(InputError, match="another QIF document"):
        import_file(path, PART)


def test_a_report_in_inches_is_converted_and_one_without_a_unit_is_judged(tmp_path):
    path = tmp_path / "inch.csv"
    path.write_text(
        "Units: inch\nFeature,Nom X,Nom Y,Act X,Act Y\nA,1,1,1.0001,1\nB,9,1,9.0002,1\nC,9,7,9.0002,7.0003\n"
    )
    item = import_file(path, ImportOptions(kind="part", origin="0,0,0"))
    assert item.data.nominal_mm[1].tolist() == pytest.approx([228.6, 25.4, 0.0])
    path.write_text("Feature,Nom X,Nom Y,Act X,Act Y\nA,1,1,1.0001,1\nB,9,1,9.0002,1\nC,9,7,9.0002,7.0003\n")
    assert "--unit position" in " ".join(import_file(path, ImportOptions(kind="part", origin="0,0,0")).doubts)


@pytest.mark.parametrize("origin", ["1,2", "a,b,c", "1,2,nan"])
def test_an_origin_is_three_numbers(tmp_path, origin):
    path = tmp_path / "cmm.csv"
    path.write_text(TABLE, encoding="utf-8")
    with pytest.raises(InputError, match="three numbers"):
        import_file(path, ImportOptions(kind="part", origin=origin))


def test_an_origin_that_contradicts_the_report_is_refused(tmp_path):
    path = tmp_path / "cmm.txt"
    path.write_text(PRINTS["blanks"], encoding="utf-8")
    with pytest.raises(InputError, match="--origin"):
        import_file(path, ImportOptions(kind="part", origin="0,0,0"))


def test_set_ups_on_the_sheets_of_a_workbook(tmp_path):
    from openpyxl import Workbook

    book = Workbook()
    for k, sheet in enumerate((book.active, book.create_sheet("Lage 2"))):
        sheet.append(["Bohrung", "X Soll", "Y Soll", "X Ist", "Y Ist"])
        for name, n, a in zip(NAMES, GRID, printed(shift=(0.01 * k, 0.0, 0.0)), strict=True):
            sheet.append([name, n[0], n[1], round(a[0], 4), round(a[1], 4)])
    path = tmp_path / "cmm.xlsx"
    book.save(path)
    assert "--clamping" in " ".join(import_file(path, PART).doubts)
    item = import_file(path, ImportOptions(kind="part", origin="-700,-900,-250", clamping="each"))
    assert (item.doubts, sorted(set(item.data.setup))) == ((), [1, 2])
    both = item.data.deviations().deviation_mm[:, :2].reshape(2, len(GRID), 2)
    assert np.allclose(both[0], both[1], atol=1e-4)  # each set-up has its own pose


# Logs in words: each line names its numbers, as print commands of measuring cycles write them.

PLATE = {f"H{i}{j}": (50.0 + 100.0 * i, 40.0 + 90.0 * j) for i in range(4) for j in range(3)}


def as_measured(x, y):
    """A machine that travels 40 um/m too far in X and 25 um/m too little in Y made the part: the part is that."""
    return x * (1 + 40e-6), y * (1 - 25e-6)


def line_of_cycle(name, x, y):
    a, b = as_measured(x, y)
    return f"MESSUNG {name}  Q151 = {a:+.4f}  Q152 = {b:+.4f}  SOLL Q273 = {x:.4f} Q274 = {y:.4f}"


def line_of_words(name, x, y):
    a, b = as_measured(x, y)
    parts = (
        f"{k} {value:.4f}".replace(".", ",") for k, value in (("Sollwert X", x), ("Istwert X", a), ("Differenz", a - x))
    )
    other = (
        f"{k} {value:.4f}".replace(".", ",") for k, value in (("Sollwert Y", y), ("Istwert Y", b), ("Differenz", b - y))
    )
    return f"{name}: {' '.join(parts)}; {' '.join(other)}"


def line_in_english(name, x, y):
    a, b = as_measured(x, y)
    return f"{name} | Nominal X = {x:.4f} | Actual X = {a:.4f} | Nominal Y = {y:.4f} | Actual Y = {b:.4f}"


LOGS = (line_of_cycle, line_of_words, line_in_english)


@pytest.mark.parametrize("write", LOGS)
def test_a_log_in_words_is_the_part_that_its_numbers_say(write, tmp_path):
    path = tmp_path / "log.txt"
    path.write_text("\n".join(write(name, *place) for name, place in PLATE.items()) + "\n", encoding="utf-8")
    data = import_file(path, ImportOptions(kind="part", origin="0,0,0")).data
    assert list(data.feature) == [name if write is not line_of_cycle else f"MESSUNG {name}" for name in PLATE]
    places = np.array(list(PLATE.values()))
    assert np.allclose(data.nominal_mm[:, :2], places)
    assert np.allclose(data.measured_mm[:, :2], np.column_stack(as_measured(*places.T)), atol=6e-5)


@pytest.mark.parametrize("write", LOGS)
@pytest.mark.parametrize("row", [0, 5, 11])
def test_a_line_of_a_log_whose_number_is_missing_is_named(write, row, tmp_path):
    """Otherwise the next number would be taken for that of another coordinate."""
    lines = [write(name, *place) for name, place in PLATE.items()]
    numbers = list(re.finditer(r"[-+]?\d+[.,]\d{4}", lines[row]))
    lines[row] = lines[row][: numbers[1].start()] + "n.a." + lines[row][numbers[1].end() :]
    path = tmp_path / "log.txt"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError) as caught:
        import_file(path, ImportOptions(kind="part", origin="0,0,0"))
    assert caught.value.line == row + 1


@pytest.mark.parametrize("kind", ["part", "artefact"])
def test_coordinates_that_fit_exactly_are_identified_with_the_sign_of_their_kind(kind, tmp_path):
    """Neat numbers, as of a made example: their residuals are zero, which leaves the uncertainty of what is assumed of them."""
    path = tmp_path / "log.txt"
    places = [(50.0 + 70.0 * i, 40.0 + 40.0 * j) for i in range(8) for j in range(9)]
    path.write_text("\n".join(line_in_english(f"H{k}", *place) for k, place in enumerate(places)) + "\n")
    machine = compgen.load_machine("moving-table-mill")
    answers = ImportOptions(kind=kind, origin="0,0,0", calibrated="yes" if kind == "artefact" else None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        found = identify_measurement(machine, open_measurement([path], answers=answers))
    curve = found.errors.curves["EXX"]
    rise_mm = float(curve.at(np.array([540.0]))[0] - curve.at(np.array([60.0]))[0])
    # the part has the error of the machine that made it; a probe reads what the machine should have travelled
    assert rise_mm == pytest.approx((1 if kind == "part" else -1) * 40e-6 * 480.0, rel=0.05)
    assert (curve.u[1:] > 1e-6).any()
