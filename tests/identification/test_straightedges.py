"""How a straightedge lay is no squareness of the machine, by whatever way its readings come; both arms of one square are."""

import warnings

import numpy as np
import openpyxl
import pytest

import compgen
from compgen.data.error_table import ARMS, SQUARENESS_APART, Curve, ErrorTable, format_errors, read_errors
from compgen.data.names import CURVE_NAMES, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.errors import CompgenWarning
from compgen.fitting import fit
from compgen.foreign import ImportOptions, import_file, open_errors, open_measurement
from compgen.foreign.converted import given_errors
from compgen.identification.options import StatedNumbers
from compgen.kinematics import volumetric_error
from compgen.pipeline import identify_bare

#: Rise of a straightedge that lies at 0.2 mm/m, and standard uncertainty of a gauge.
LAY, U_MM = 200e-6, 0.5 * MM_PER_UM
STRAIGHT = tuple(name for name in CURVE_NAMES if error_named(name).is_straightness)


def edge(machine, name, slope=LAY, *, bow_um=0.0, part=(0.0, 1.0), u_mm=U_MM, nodes=9, zero_mm=0.0):
    """Readings along a part of the travel on a straightedge that rises, of a guide with a bow."""
    low, high = machine.axes[error_named(name).axis].range_mm
    at = low + (high - low) * np.linspace(*part, nodes)
    share = (at - at[0]) / np.ptp(at)
    value = zero_mm + slope * (at - at[0]) + 4.0 * bow_um * MM_PER_UM * share * (1.0 - share)
    return Curve(at, value, np.full(nodes, u_mm))


def identified(machine, table, **how):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        return given_errors(machine, table, **how)


@pytest.mark.parametrize("name", STRAIGHT)
@pytest.mark.parametrize("part", [(0.0, 1.0), (0.25, 0.75)])
def test_the_line_of_a_single_straightness_is_never_squareness(small_machine, name, part):
    curve = edge(small_machine, name, bow_um=3.0, part=part, zero_mm=0.07)
    found = identified(small_machine, ErrorTable({name: curve})).errors
    assert found.names == (name,)
    assert found.curves[name].at(curve.position_mm) == pytest.approx(
        edge(small_machine, name, 0.0, bow_um=3.0, part=part).value, abs=1e-12
    )


def test_a_straight_edge_that_lies_askew_says_nothing_but_how_it_lay(tmp_path, small_machine, call):
    """The reproduction of the issue: 0.2 mm/m made EC0Y of -200 urad and tables of 100 um."""
    path = tmp_path / "edge.errors.csv"
    path.write_text(format_errors(ErrorTable({"EYX": edge(small_machine, "EYX")})))
    code, _, err = call("identify", small_machine.source, path, "--out", tmp_path / "o")
    assert code == 0
    assert "EYX rises by 100 um from end to end (200 urad): how the straightedge lay" in err
    assert "EC0Y" not in (tmp_path / "o" / "identified.errors.csv").read_text()
    code, _, _ = call(
        "run", small_machine.source, path, "--controller", "isg-csv", "--no-report", "--out", tmp_path / "t"
    )
    assert code == 1  # there is nothing to compensate
    assert [item.name for item in (tmp_path / "t").glob("*volcomp0.csv")] == ["NOT-ACCEPTED-volcomp0.csv"]


def test_the_zero_of_a_level_is_no_squareness(small_machine):
    at = np.linspace(*small_machine.axes[0].range_mm, 6)
    level = Curve(at, 100e-6 + 1e-8 * at, np.full(6, 1e-6))
    found = identified(small_machine, ErrorTable({"EBX": level})).errors
    assert found.names == ("EBX",)
    assert found.curves["EBX"].at(np.array([-50.0, 150.0])).tolist() == pytest.approx([0.0, 2e-6])


def test_what_is_left_has_the_noise_of_the_line_as_well(small_machine):
    rng = np.random.default_rng(4)
    left = []
    for _ in range(150):
        curve = edge(small_machine, "EXY", bow_um=2.0, part=(0.1, 0.6), nodes=5)
        noisy = Curve(curve.position_mm, curve.value + rng.normal(0.0, U_MM, 5), curve.u)
        left.append(identified(small_machine, ErrorTable({"EXY": noisy})).errors.curves["EXY"].at(curve.position_mm))
    found = identified(small_machine, ErrorTable({"EXY": curve})).errors.curves["EXY"]
    stated = np.interp(curve.position_mm, found.position_mm, found.u)
    assert stated[2] == pytest.approx(np.sqrt(1.5) * U_MM)
    assert np.std(left, axis=0) == pytest.approx(stated, rel=0.2)


@pytest.mark.filterwarnings("ignore:.* is known from")
@pytest.mark.parametrize("square", ARMS)
@pytest.mark.parametrize(("one", "other"), [(2e-5, 3e-5), (0.0, -4e-5), (-1e-5, 0.0)])
@pytest.mark.parametrize("part", [(0.0, 1.0), (0.5, 0.9)])
def test_both_arms_of_one_square_are_squareness(small_machine, square, one, other, part):
    """By the formula of docs/instruments.md, -a/A - b/B for EC0Y; in general by the angle between the paths of the tool."""
    table = ErrorTable(
        {
            name: edge(small_machine, name, slope, part=part, zero_mm=0.02)
            for name, slope in zip(ARMS[square], (one, other), strict=True)
        }
    )
    with pytest.warns(CompgenWarning, match=f"{square} = .* read as the arms of one square"):
        found = given_errors(small_machine, table).errors
    start = np.array([axis.range_mm[0] for axis in small_machine.axes])
    first, second = (axis for axis in range(3) if axis != error_named(square).direction)
    ends = start + 100.0 * np.array([np.zeros(3), np.eye(3)[first], np.eye(3)[second]])
    origin, along, across = ends + volumetric_error(small_machine, found, ends)
    # the reading grows where the tool moves towards the arm, so the angle of its paths is smaller by both slopes
    cosine = (along - origin) @ (across - origin) / 100.0**2
    assert np.arccos(cosine) - np.pi / 2 == pytest.approx(-one - other, abs=1e-9)
    spans = [np.ptp(table.curves[name].position_mm) for name in ARMS[square]]
    assert found.squareness[square][1] == pytest.approx(np.hypot(*(np.sqrt(2) * U_MM / span for span in spans)))


def test_two_straightedges_each_with_its_own_lay_are_no_square(tmp_path, small_machine):
    """In two files, on two sheets, or in one file that says so."""
    tables = [ErrorTable({name: edge(small_machine, name)}) for name in ("EYX", "EXY")]
    paths = [tmp_path / f"{name}.errors.csv" for name in "ab"]
    for path, table in zip(paths, tables, strict=True):
        path.write_text(format_errors(table))
    with pytest.warns(CompgenWarning, match="how the straightedge lay"):
        found = identify_bare(small_machine, open_measurement(paths))
    assert found.errors.names == ("EYX", "EXY")
    both = ErrorTable({**tables[0].curves, **tables[1].curves}, {}, {"squareness": SQUARENESS_APART})
    assert identified(small_machine, both).errors.names == ("EYX", "EXY")
    book = openpyxl.Workbook()
    for sheet, (name, across) in zip((book.active, book.create_sheet()), (("X", "Y"), ("Y", "X")), strict=True):
        sheet.title = f"{name} axis"
        sheet.append(["Position [mm]", f"Straightness {across} [um]"])
        for at in (0.0, 50.0, 100.0, 150.0):
            sheet.append([at, 0.2 * at])
    book.save(tmp_path / "lab.xlsx")
    read = import_file(tmp_path / "lab.xlsx", ImportOptions(sign="error")).data
    assert read.names == ("EYX", "EXY")
    assert read.metadata["squareness"] == SQUARENESS_APART


@pytest.mark.parametrize("header", ["Position [mm];Straightness Y [um]", "Position [mm];EYX [um]"])
def test_an_imported_straightness_says_so_to_every_command(tmp_path, small_machine, header):
    """Also after it was written in the native form, and for a fit or tables without an identification."""
    rows = "".join(f"{x};{0.2 * (x + 300):.3f}\n" for x in range(-300, 201, 100))
    (tmp_path / "x-axis.csv").write_text(f"X-axis\n{header}\n{rows}")
    item = import_file(tmp_path / "x-axis.csv", ImportOptions(sign="error"))
    (text,) = item.files().values()
    (tmp_path / "x.errors.csv").write_text(text)
    native = open_errors(tmp_path / "x.errors.csv")
    assert read_errors(tmp_path / "x.errors.csv").curves["EYX"].value[-1] == pytest.approx(0.1)
    assert native.curves["EYX"].value == pytest.approx(np.zeros(6))
    for table in (item.data, native):
        assert fit(small_machine, table).errors.names == ("EYX",)


def test_repeated_straightness_of_one_axis_is_averaged_and_gives_no_squareness(tmp_path, small_machine, call):
    """Two straightedges one after the other: each with its own lay."""
    for k, slope in enumerate((200e-6, -80e-6)):
        table = ErrorTable({"EYX": edge(small_machine, "EYX", slope, bow_um=3.0, nodes=6)})
        (tmp_path / f"{k}.errors.csv").write_text(format_errors(table))
    code, _, err = call(
        "identify",
        small_machine.source,
        tmp_path / "0.errors.csv",
        tmp_path / "1.errors.csv",
        "--out",
        tmp_path / "o",
    )
    assert code == 0, err
    found = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert found.names == ("EYX",)
    at = np.array([-50.0])
    assert found.curves["EYX"].at(at) == pytest.approx(edge(small_machine, "EYX", 0.0, bow_um=3.0).at(at), rel=0.05)


def test_a_table_with_squareness_is_one_set_of_errors(small_machine):
    """As another program writes it: the line of its straightness is a part of the squareness, and that is said."""
    table = ErrorTable({"EYX": edge(small_machine, "EYX", 5e-6)}, {"EC0Y": (2e-5, 1e-6)})
    with pytest.warns(CompgenWarning, match="this line counts as a part of the squareness"):
        found = given_errors(small_machine, table).errors
    assert found.squareness["EC0Y"][0] == pytest.approx(15e-6)
    apart = table.replace(metadata={"squareness": SQUARENESS_APART})
    assert identified(small_machine, apart).errors.squareness["EC0Y"] == pytest.approx((2e-5, 1e-6))


def test_a_stated_squareness_stays_as_it_is_beside_a_straightedge(tmp_path, small_machine, call):
    (tmp_path / "edge.errors.csv").write_text(format_errors(ErrorTable({"EYX": edge(small_machine, "EYX")})))
    words = ["identify", small_machine.source, tmp_path / "edge.errors.csv", "--squareness", "EC0Y=25±3"]
    code, _, err = call(*words, "--out", tmp_path / "o")
    assert code == 0, err
    found = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert found.squareness["EC0Y"] == pytest.approx((25 * RAD_PER_URAD, 3 * RAD_PER_URAD))
    stated = StatedNumbers(squareness={"EC0Y": "25±3"}).errors(small_machine)
    assert isinstance(stated, compgen.ErrorTable)
