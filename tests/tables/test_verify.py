"""The judgement on written text: good tables pass, every kind of wrong one is rejected with the place that is wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.prior import PriorSettings
from compgen.errors import InputError
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volumetric_error
from compgen.tables import Residuals, export, projector, read_tables, residuals, verify, without_rigid_motion

PICOMETRE = 1e-9
NANOMETRE = 1e-6


def swapped_name(name):
    """The name after X and Y (and A and B) change places; C0Y has no counterpart."""
    return name if name == "C0Y" else name.translate(str.maketrans("XYAB", "YXBA"))


# --- how to spoil the text of each control ---------------------------------------------------------------------------
#
# A spoiler maps the text of the file that holds the numbers to a wrong text that is still well formed.


class IsgText:
    """Blocks of columns under a line of names; ``//`` comments; the number of records is declared."""

    file = "volcomp0.csv"
    one_curve = "EBX"
    one_curve_place = r"X\(x,z\)"

    @staticmethod
    def edit(text, change, names=lambda names: names, keep=lambda names, row: True):
        """Apply ``change(name, word)`` to every number, ``names`` to lines of names, drop rows that are not kept."""
        lines, current, records = [], [], 0
        for line in text.splitlines():
            words = line.split()
            if not words or line.startswith(("//", "#")):
                lines.append(line)
            elif words[0][-1].isalpha():
                current = words
                lines.append(" ".join(names(words)))
            elif keep(current, words):
                records += 1
                pairs = zip(current, words, strict=True)
                lines.append(" ".join(word if len(name) == 1 else change(name, word) for name, word in pairs))
        return re.sub(r"// records: \d+", f"// records: {records}", "\n".join(lines) + "\n")

    @classmethod
    def scaled(cls, text, factor):
        return cls.edit(text, lambda name, word: f"{float(word) * factor:.12f}")

    @classmethod
    def swapped(cls, text):
        return cls.edit(text, lambda name, word: word, names=lambda names: [swapped_name(name) for name in names])

    @classmethod
    def one_flipped(cls, text):
        return cls.edit(text, lambda name, word: f"{-float(word):.12f}" if name == cls.one_curve else word)

    @classmethod
    def halved(cls, text):
        return cls.edit(text, lambda name, word: word, keep=lambda names, row: names[0] != "X" or float(row[0]) <= -50)


class EtalonText:
    """``[NAME]`` with VALUE or rows in braces; the number of records is declared."""

    file = "volcomp0.etalon.txt"
    one_curve = "EBX"
    one_curve_place = r"X\(x,z\)"

    @staticmethod
    def edit(text, change, keep=lambda name, row: True):
        lines, name, records = [], "", 0
        for line in text.splitlines():
            words = line.split()
            if line.startswith("["):
                name = line[1:-1]
            elif line.startswith("VALUE"):
                records += 1
                line = f"VALUE = {change(name, words[2])}"
            elif len(words) == 2 and re.fullmatch(r"[-0-9.]+", words[0]):
                if not keep(name, words):
                    continue
                records += 1
                line = f"{words[0]} {change(name, words[1])}"
            lines.append(line)
        return re.sub(r"// records: \d+", f"// records: {records}", "\n".join(lines) + "\n")

    @classmethod
    def scaled(cls, text, factor):
        return cls.edit(text, lambda name, word: f"{float(word) * factor:.12f}")

    @classmethod
    def swapped(cls, text):
        return re.sub(r"^\[(\w+)\]", lambda match: f"[{swapped_name(match[1])}]", text, flags=re.MULTILINE)

    @classmethod
    def one_flipped(cls, text):
        return cls.edit(text, lambda name, word: f"{-float(word):.12f}" if name == cls.one_curve else word)

    @classmethod
    def halved(cls, text):
        return cls.edit(text, lambda name, word: word, keep=lambda name, row: name[-1] != "X" or float(row[0]) <= -50)


class EecText:
    """``$AA_ENC_COMP[0,node,axis]=value``."""

    file = "AX_EEC.INI"
    one_curve_place = r"Z linear in z|Z\(z\)"
    value = re.compile(r"(\$AA_ENC_COMP\[0,(\d+),(AX\d)\]=)(\S+)")

    @classmethod
    def edit(cls, text, change):
        return cls.value.sub(lambda m: f"{m[1]}{change(m[3], float(m[4])):.6f}", text)

    @classmethod
    def scaled(cls, text, factor):
        return cls.edit(text, lambda axis, value: value * factor)

    @classmethod
    def swapped(cls, text):
        return text.replace("AX1", "AX#").replace("AX2", "AX1").replace("AX#", "AX2")

    @classmethod
    def one_flipped(cls, text):
        return cls.edit(text, lambda axis, value: -value if axis == "AX3" else value)

    @classmethod
    def halved(cls, text):
        """The X table ends at the node next to the middle."""
        count = sum(match[3] == "AX1" for match in cls.value.finditer(text))
        start, step = (float(re.search(rf"_{key}\[0,AX1\]=(\S+)", text)[1]) for key in ("MIN", "STEP"))
        last = count // 2
        lines = [
            line
            for line in text.splitlines()
            if not (match := cls.value.match(line)) or match[3] != "AX1" or int(match[2]) <= last
        ]
        return re.sub(r"(_MAX\[0,AX1\]=)\S+", rf"\g<1>{start + last * step:.6f}", "\n".join(lines) + "\n")


class CecText:
    """``$AN_CEC[table,node]=value``; products name their second factor."""

    file = "NC_CEC.INI"
    one_curve_place = r"\w\(\w,\w\)"
    value = re.compile(r"(\$AN_CEC\[(\d+),(\d+)\]=)(\S+)")

    @classmethod
    def edit(cls, text, change):
        return cls.value.sub(lambda m: f"{m[1]}{change(m[2], float(m[4])):.9f}", text)

    @classmethod
    def scaled(cls, text, factor):
        return cls.edit(text, lambda table, value: value * factor)

    swapped = EecText.swapped

    @classmethod
    def one_flipped(cls, text):
        """The first table that is multiplied by another."""
        table = re.search(r"\$AN_CEC_MULT_BY_TABLE\[(\d+)\]=[1-9]", text)[1]
        return cls.edit(text, lambda number, value: -value if number == table else value)

    @classmethod
    def halved(cls, text):
        """Table 0 over X, from -300 to 200 mm in steps of 100, ends at -100 mm."""
        kept = [line for line in text.splitlines() if not re.match(r"\$AN_CEC\[0,[345]\]", line)]
        return "\n".join(kept).replace("_MAX[0]=200.", "_MAX[0]=-100.") + "\n"


class PitchText:
    """``N1....P value`` in counts, and parameters 3620 ... 3624 with one pair A, P per axis."""

    file = "PITCH.TXT"
    one_curve_place = r"Z linear in z|Z\(z\)"

    @classmethod
    def edit(cls, text, change):
        return re.sub(
            r"^N1(\d{4})P(-?\d+)$", lambda m: f"N1{m[1]}P{change(int(m[1]), int(m[2]))}", text, flags=re.MULTILINE
        )

    @classmethod
    def scaled(cls, text, factor):
        """Whole counts within the 16 bits of the control."""
        return cls.edit(text, lambda number, value: max(-32768, min(32767, round(value * factor))))

    @classmethod
    def swapped(cls, text):
        return text.replace("A1P", "A#P").replace("A2P", "A1P").replace("A#P", "A2P")

    @classmethod
    def axis_numbers(cls, text, axis):
        first, last = (re.search(rf"^N0362{digit}.*A{axis}P(\d+)", text, flags=re.MULTILINE)[1] for digit in "12")
        return range(int(first), int(last) + 1)

    @classmethod
    def one_flipped(cls, text):
        mine = cls.axis_numbers(text, 3)
        return cls.edit(text, lambda number, value: -value if number in mine else value)

    @classmethod
    def halved(cls, text):
        """The X table begins in the middle: the points before it and parameter 3621 go."""
        mine = cls.axis_numbers(text, 1)
        reference = int(re.search(r"^N03620.*?A1P(\d+)", text, flags=re.MULTILINE)[1])
        first = mine[0] + (reference - mine[0]) // 2
        dropped = {f"N1{number:04d}" for number in range(mine[0], first)}
        kept = "\n".join(line for line in text.splitlines() if line.partition("P")[0] not in dropped) + "\n"
        return re.sub(rf"^(N03621A1P){mine[0]}(?=A)", rf"\g<1>{first}", kept, flags=re.MULTILINE)


TEXTS = {
    "isg-csv": IsgText,
    "etalon-exchange": EtalonText,
    "siemens-eec": EecText,
    "siemens-cec": CecText,
    "fanuc-pitch": PitchText,
}
#: The controls whose text is spoiled here; tests/tables/test_crash.py does the same to the tables of every control.
ALL = sorted(TEXTS)


@pytest.fixture(scope="module")
def exported(small_machine, small_errors):
    """Good texts of every control by name, made once."""
    return {name: export(small_machine, small_errors, name).files for name in ALL}


def judged(machine, errors, name, files, folder):
    """Write texts, read them back and judge them."""
    paths = []
    for file, text in files.items():
        paths.append(folder / file)
        paths[-1].write_bytes(text.encode("ascii"))
    return verify(machine, read_tables(machine, paths, name), errors)


def spoiled(exported, name, change):
    """The texts of a control with one file changed; a change that changes nothing is a mistake of the test."""
    spoiler = TEXTS[name]
    files = dict(exported[name])
    wrong = change(spoiler, files[spoiler.file])
    assert wrong != files[spoiler.file]
    return {**files, spoiler.file: wrong}


@pytest.mark.parametrize("name", ALL)
def test_a_good_table_is_accepted(name, small_machine, small_errors, exported, tmp_path):
    result = judged(small_machine, small_errors, name, exported[name], tmp_path)
    assert result.accepted, result.reasons
    assert result.after_rigid_removed.rms_um < result.before_rigid_removed.rms_um
    assert result.summary()["reasons"] == []


@pytest.mark.parametrize("name", ALL)
def test_an_edit_that_changes_no_number_is_accepted(name, small_machine, small_errors, exported, tmp_path):
    """The spoilers themselves do no harm: what is rejected below is rejected for its numbers."""
    files = dict(exported[name])
    files[TEXTS[name].file] = TEXTS[name].scaled(files[TEXTS[name].file], 1)
    assert judged(small_machine, small_errors, name, files, tmp_path).accepted


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda spoiler, text: spoiler.scaled(text, -1), r"correction X.* sign is reversed"),
        (lambda spoiler, text: spoiler.swapped(text), r"correction [XY]\b"),
        (lambda spoiler, text: spoiler.scaled(text, 1000), r"correction X\b"),
        (lambda spoiler, text: spoiler.scaled(text, 0.001), r"correction X\b"),
        (lambda spoiler, text: spoiler.halved(text), r"the travel is -300 \.\.\. 200 mm"),
    ],
    ids=["sign", "axes", "too-large", "too-small", "half-travel"],
)
def test_a_wrong_table_is_rejected_with_the_place(name, change, place, small_machine, small_errors, exported, tmp_path):
    result = judged(small_machine, small_errors, name, spoiled(exported, name, change), tmp_path)
    assert not result.accepted
    assert any(re.search(place, reason) for reason in result.reasons), result.reasons
    assert result.summary()["accepted"] is False


@pytest.mark.parametrize("name", ALL)
def test_one_curve_with_its_sign_flipped_is_rejected_and_named(name, small_machine, small_errors, exported, tmp_path):
    files = spoiled(exported, name, lambda spoiler, text: spoiler.one_flipped(text))
    result = judged(small_machine, small_errors, name, files, tmp_path)
    assert not result.accepted
    assert any(re.search(f"correction ({TEXTS[name].one_curve_place})", reason) for reason in result.reasons)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.95, 0.999])
@pytest.mark.parametrize("name", ALL)
def test_a_truncated_file_is_an_input_error(name, share, small_machine, small_errors, exported, tmp_path):
    files = spoiled(exported, name, lambda spoiler, text: text[: min(int(share * len(text)), len(text.rstrip()) - 1)])
    with pytest.raises(InputError) as caught:
        judged(small_machine, small_errors, name, files, tmp_path)
    assert caught.value.file is not None


@pytest.mark.parametrize("name", ALL)
def test_a_large_squareness_does_not_hide_a_small_wrong_curve(name, small_machine, make_errors, tmp_path):
    """Beside 2.9 mrad the rest is small, yet one curve of 25 urad with its sign flipped is found."""
    machine = replace(small_machine, prior=PriorSettings(class_name="none"))  # not how probable it is that tables help
    errors = make_errors(machine, squareness_rad=(2.9e-3, -30e-6, 25e-6))
    files = {name: export(machine, errors, name).files}
    assert judged(machine, errors, name, files[name], tmp_path).accepted
    wrong = spoiled(files, name, lambda spoiler, text: spoiler.one_flipped(text))
    assert not judged(machine, errors, name, wrong, tmp_path).accepted


@pytest.mark.parametrize("name", ["isg-csv", "siemens-eec", "siemens-cec"])
def test_a_constant_offset_is_rejected(name, small_machine, small_errors, exported, tmp_path):
    """The positioning table of X (in a CEC set: table 0) is shifted by 0.05 mm as a whole."""
    shifts = {
        "isg-csv": lambda text: IsgText.edit(text, lambda key, word: f"{float(word) + 0.05 * (key == 'EXX'):.12f}"),
        "siemens-eec": lambda text: EecText.edit(text, lambda axis, value: value + 0.05 * (axis == "AX1")),
        "siemens-cec": lambda text: CecText.edit(text, lambda table, value: value + 0.05 * (table == "0")),
    }
    files = spoiled(exported, name, lambda spoiler, text: shifts[name](text))
    result = judged(small_machine, small_errors, name, files, tmp_path)
    assert any(reason.startswith("correction X constant: ") for reason in result.reasons), result.reasons


@pytest.mark.parametrize("node", [1, 7, 33, 98])
def test_a_single_wrong_node_of_a_fine_table_is_found(node, small_machine, small_errors, tmp_path):
    """With a node every 5 mm the one that is wrong lies between the points where means are taken."""
    section = toml_files.Section({"step_mm": {"X": 5.0}}, path=None, name="controllers.siemens-eec")
    machine = replace(small_machine, controllers={"siemens-eec": section})
    files = dict(export(machine, small_errors, "siemens-eec").files)
    assert judged(machine, small_errors, "siemens-eec", files, tmp_path).accepted
    files[EecText.file] = re.sub(rf"(\$AA_ENC_COMP\[0,{node},AX1\]=)\S+", r"\g<1>0.250000", files[EecText.file])
    result = judged(machine, small_errors, "siemens-eec", files, tmp_path)
    place = f"correction X at X {-300 + 5 * node:g} Y "
    assert any(reason.startswith(place) and "-250.00 um in the table" in reason for reason in result.reasons)


def test_a_peak_between_the_nodes_is_found(small_machine, small_errors, exported, tmp_path):
    """Three rows are put into the X block of a table whose nodes are 100 mm apart."""
    lines = exported["isg-csv"]["volcomp0.csv"].splitlines()
    row = next(k for k, line in enumerate(lines) if line.split()[:1] == ["-200.000000"])
    width = len(lines[row].split())
    lines[row:row] = [
        " ".join([f"{x}.000000", *["0.300000"] * (x == -222), *["0.0"] * (width - 1)][:width])
        for x in (-223, -222, -221)
    ]
    text = re.sub(r"// records: (\d+)", lambda match: f"// records: {int(match[1]) + 3}", "\n".join(lines) + "\n")
    result = judged(small_machine, small_errors, "isg-csv", {"volcomp0.csv": text}, tmp_path)
    assert any(reason.startswith("correction X at X -222 Y ") for reason in result.reasons), result.reasons


@pytest.mark.parametrize("u_factor", [1.0, 1e6])
def test_uncertain_errors_do_not_excuse_a_wrong_sign(u_factor, small_machine, small_errors, exported, tmp_path):
    vague = {key: replace(curve, u=curve.u * u_factor) for key, curve in small_errors.curves.items()}
    errors = small_errors.replace(curves=vague)
    files = spoiled(exported, "isg-csv", lambda spoiler, text: spoiler.scaled(text, -1))
    bare = replace(small_machine, prior=PriorSettings(class_name="none"))
    for machine in (small_machine, bare):
        assert not judged(machine, errors, "isg-csv", files, tmp_path).accepted
    assert judged(bare, errors, "isg-csv", exported["isg-csv"], tmp_path).accepted
    # with a prior, values that say nothing do not make a machine better
    found = judged(small_machine, errors, "isg-csv", exported["isg-csv"], tmp_path)
    assert found.accepted == (u_factor == 1.0)
    assert (found.gain.probability_better > 0.8) == (u_factor == 1.0)


def test_a_byte_that_is_not_ascii_is_named_with_its_line(small_machine, tmp_path):
    path = tmp_path / "volcomp0.csv"
    path.write_bytes(b"// first\n// caf\xc3\xa9\n")
    with pytest.raises(InputError, match="ASCII") as caught:
        read_tables(small_machine, path, "isg-csv")
    assert caught.value.line == 2


def test_no_file_is_an_input_error(small_machine):
    with pytest.raises(InputError, match="no table file"):
        read_tables(small_machine, [], "isg-csv")


# --- figures ---------------------------------------------------------------------------------------------------------


def test_residual_figures_are_those_of_hand_calculation():
    """Vectors of length 5, 2, 1 and 0 um: rms = sqrt(30/4); 95 % lies at 2 + 0.85 (5 - 2) = 4.55 um."""
    error_mm = np.array([[3, 4, 0], [0, 0, -2], [-1, 0, 0], [0, 0, 0]]) * 1e-3
    figures = residuals(error_mm)
    expected = Residuals(max_um=5, rms_um=7.5**0.5, p95_um=4.55, v_x_um=4, v_y_um=4, v_z_um=2)
    for key, value in expected.as_dict().items():
        assert getattr(figures, key) == pytest.approx(value, abs=1e-9), key


@pytest.mark.parametrize("axis_rad", [(0, 0, 0), (5e-3, 0, 0), (-2e-3, 3e-3, 4e-3), (0.4, -0.7, 0.2)])
def test_a_rigid_motion_is_removed_exactly(axis_rad):
    from scipy.spatial.transform import Rotation

    position = np.random.default_rng(4).uniform([-800, -1000, -350], [0, 0, 0], (300, 3))
    moved = Rotation.from_rotvec(axis_rad).apply(position) + np.array([0.3, -1.2, 0.05])
    assert np.max(np.abs(without_rigid_motion(position, moved - position))) < 1e3 * PICOMETRE


def test_a_rigid_motion_on_top_changes_nothing_that_remains():
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(6)
    position = generator.uniform([-800, -1000, -350], [0, 0, 0], (300, 3))
    error = generator.normal(scale=0.01, size=(300, 3))
    turn = Rotation.from_rotvec([1e-3, -4e-3, 2e-3])
    moved = turn.apply(position + error) + np.array([0.1, 0.2, -0.3])
    before, after = without_rigid_motion(position, error), without_rigid_motion(position, moved - position)
    assert np.max(np.abs(before - after)) < 1e3 * PICOMETRE
    assert residuals(before).rms_um < residuals(error).rms_um


def test_a_mirrored_plane_is_not_mistaken_for_a_motion():
    """Points in a plane admit a reflection across it; it must not be used."""
    generator = np.random.default_rng(8)
    position = np.column_stack([generator.uniform(-100, 100, (50, 2)), np.zeros(50)])
    error = np.column_stack([np.zeros((50, 2)), generator.normal(scale=1e-3, size=50)])
    rest = without_rigid_motion(position, error)
    assert np.max(np.abs(rest[:, :2])) < 1e-3
    assert residuals(rest).max_um < 2 * residuals(error).max_um


def test_before_and_after_are_the_exact_model_at_the_given_points(small_machine, small_errors, exported, tmp_path):
    """Against a calculation here: the errors with and without the correction, with the tool of each point."""
    generator = np.random.default_rng(9)
    points = compgen.Points(
        generator.uniform(small_machine.lower_mm, small_machine.upper_mm, (40, 3)),
        tool_mm=generator.uniform(-50, 50, (40, 3)),
    )
    for file, text in exported["isg-csv"].items():
        (tmp_path / file).write_text(text)
    tables = read_tables(small_machine, sorted(tmp_path.iterdir()), "isg-csv")
    result = verify(small_machine, tables, small_errors, points)
    correction = tables.correction(small_machine, points)
    moved = points.position_mm + correction
    after = exact_error(small_machine, small_errors, moved, points.tool_mm) + moved - points.position_mm
    assert result.points == 40
    assert result.before == residuals(exact_error(small_machine, small_errors, points.position_mm, points.tool_mm))
    assert np.max(np.abs(result.error_after_mm - after)) < PICOMETRE


def test_the_figures_are_taken_at_nodes_and_between_them(small_machine, small_errors, exported, tmp_path):
    result = judged(small_machine, small_errors, "isg-csv", exported["isg-csv"], tmp_path)
    for axis, item in enumerate(small_machine.axes):
        levels = np.unique(result.position_mm[:, axis])
        assert set(item.nodes_mm) | set(0.5 * (item.nodes_mm[1:] + item.nodes_mm[:-1])) <= set(levels)


# --- what a control cannot express -----------------------------------------------------------------------------------


def only_positioning_and(machine, name, amount_rad):
    """A machine with a constant slope of one angular error and nothing else but positioning."""
    axis = "XYZ".index(name[-1])
    nodes = machine.axes[axis].nodes_mm
    share = (nodes - machine.reference_point_mm[axis]) / 100.0
    x = machine.axes[0].nodes_mm
    unknown = np.full(len(nodes), np.nan)
    return ErrorTable(
        {
            "EXX": Curve(x, 0.01 * np.sin(x / 100) - 0.01 * np.sin(machine.reference_point_mm[0] / 100), 0 * x),
            name: Curve(nodes, amount_rad * share, unknown),
        }
    )


@pytest.mark.parametrize("name", ["siemens-cec", "siemens-eec"])
def test_angular_errors_that_stay_are_named(name, small_machine, tmp_path):
    """EBX = 20 urad per 100 mm of X: dX = Z EBX reaches tenths of um to tens of um over the volume."""
    settings = {"sign": "error", "products": False} if name == "siemens-cec" else {}
    section = toml_files.Section(settings, path=None, name=f"controllers.{name}")
    machine = replace(small_machine, controllers={name: section})
    errors = only_positioning_and(machine, "EBX", 20e-6)
    result = judged(machine, errors, name, export(machine, errors, name).files, tmp_path)
    assert list(result.uncorrected_um) == ["EBX"]
    assert result.accepted
    # The product x z less its best functions of x alone and z alone is (x - mean)(z - mean): half spans 250 and 120 mm.
    corner_um = 20e-6 / 100 * 250 * 120 * 1e3
    # Without a table over z it is (x - reference)(z - mean), and the reference point is the middle of X.
    assert result.uncorrected_um["EBX"] == pytest.approx(corner_um, rel=0.02)
    if name == "siemens-cec":
        assert result.unrepresentable_um == pytest.approx(corner_um, rel=0.02)


def test_with_products_nothing_is_left(small_machine, tmp_path):
    errors = only_positioning_and(small_machine, "EBX", 20e-6)
    result = judged(small_machine, errors, "siemens-cec", export(small_machine, errors, "siemens-cec").files, tmp_path)
    assert result.uncorrected_um == {}
    assert result.after.max_um < 0.05


def test_pitch_tables_leave_straightness_squareness_and_angles(small_machine, small_errors, exported, tmp_path):
    result = judged(small_machine, small_errors, "siemens-eec", exported["siemens-eec"], tmp_path)
    assert {"EC0Y", "EB0Z", "EA0Z", "EYX", "EZX", "EBX", "EAX"} <= set(result.uncorrected_um)
    assert not {"EXX", "EYY", "EZZ"} & set(result.uncorrected_um)
    assert list(result.uncorrected_um.values()) == sorted(result.uncorrected_um.values(), reverse=True)


def test_one_error_alone_is_uncorrected_by_its_own_displacement(small_machine, exported, tmp_path):
    """EZX cannot be held by a pitch table at all: all of it stays but the constant part (the mean over the volume)."""
    nodes = small_machine.axes[0].nodes_mm
    value = 0.01 * np.sin(np.pi * (nodes - nodes[0]) / (nodes[-1] - nodes[0]))
    errors = ErrorTable({"EZX": Curve(nodes, value, np.full(len(nodes), np.nan))})
    files = export(small_machine, errors, "siemens-eec").files
    result = judged(small_machine, errors, "siemens-eec", files, tmp_path)
    assert volumetric_error(small_machine, errors, np.array([[-50.0, 0, 0]]))[0, 2] == pytest.approx(
        np.interp(-50.0, nodes, value)
    )
    mean = np.trapezoid(value, nodes) / (nodes[-1] - nodes[0])
    expected_um = 1e3 * np.max(np.abs(value - mean))
    assert result.uncorrected_um["EZX"] == pytest.approx(expected_um, abs=0.002)


@pytest.mark.parametrize("more_nodes", [False, True])
@pytest.mark.parametrize("name", ["fanuc-pitch", "heidenhain-com", "isg-csv", "siemens-cec", "siemens-eec"])
def test_what_is_left_of_every_single_error_is_its_least_squares_residual(
    name, more_nodes, small_machine, small_errors, tmp_path
):
    """Errors that the tables hold exactly are not projected: the figures are those of projecting every one."""
    errors = small_errors
    if more_nodes:  # bends between the nodes of the tables: of no error but the squareness do tables hold all
        curves = {}
        for axis, curve in errors.curves.items():
            position = np.linspace(curve.position_mm[0], curve.position_mm[-1], 40)
            value = curve.at(position) * (1.0 + 0.3 * np.sin(np.linspace(0.0, 30.0, 40)))
            curves[axis] = Curve(position, value, np.full(40, 1e-9))
        errors = errors.replace(curves=curves)
    files = export(small_machine, errors, name, allow_unverified=True).files
    result = judged(small_machine, errors, name, files, tmp_path)
    control = CONTROLLERS[name](small_machine)
    solver = projector(small_machine, control.basis(errors), anchored=control.anchored)
    expected_um = {}
    for error in errors.names:
        required = -volumetric_error(small_machine, errors.only(error), solver.position_mm)
        rest = required - solver.field(solver.project(required))
        if control.anchored:
            rest = rest - np.average(rest, axis=0, weights=solver.weight)
        expected_um[error] = 1e3 * np.max(np.linalg.norm(rest, axis=1))
    assert result.uncorrected_um == pytest.approx({k: v for k, v in expected_um.items() if v > 0.1}, abs=0.002)
    small = [error for error, um in expected_um.items() if um < 1e-3]
    assert len(small) >= (1 if name.startswith(("fanuc", "siemens-eec")) else 3) or more_nodes


# --- the example -----------------------------------------------------------------------------------------------------

RESIDUAL_MAX_UM = 2.0
RESIDUAL_RMS_UM = 0.8
SQUARENESS_URAD = 0.8


def test_the_example_finds_the_squareness(example):
    found, true = (table.squareness["EC0Y"][0] for table in (example.identified.errors, example.truth))
    assert abs(found - true) * 1e6 < SQUARENESS_URAD
    assert 0.9 <= example.identified.reduced_chi_square <= 1.1


@pytest.mark.parametrize("name", ["isg-csv", "etalon-exchange", "siemens-cec"])
def test_the_example_machine_is_accurate_with_its_tables(name, example, tmp_path):
    """The TRUE exact machine at 2000 random points, with nothing but the text of the files."""
    machine = example.machine
    paths = export(machine, example.fitted.errors, name).write(tmp_path)
    tables = read_tables(machine, paths, name)
    position = np.random.default_rng(12345).uniform(machine.lower_mm, machine.upper_mm, (2000, 3))
    moved = position + tables.correction(machine, compgen.Points(position))
    figures = residuals(exact_error(machine, example.truth, moved) + moved - position)
    assert figures.max_um <= RESIDUAL_MAX_UM
    assert figures.rms_um <= RESIDUAL_RMS_UM
    assert residuals(exact_error(machine, example.truth, position)).max_um > 1000


def test_the_example_without_products_names_the_angular_errors(example, tmp_path):
    section = toml_files.Section({"sign": "error", "products": False}, path=None, name="controllers.siemens-cec")
    machine = replace(example.machine, controllers={"siemens-cec": section})
    files = export(machine, example.fitted.errors, "siemens-cec").files
    result = judged(machine, example.identified.errors, "siemens-cec", files, tmp_path)
    assert result.accepted, result.reasons
    assert set(result.uncorrected_um) == {"EAX", "EBX", "EAY", "EBY", "ECY"}
    assert result.unrepresentable_um > 1.0


@pytest.mark.parametrize(("noise_um", "seed"), [(0.1, 1), (2.0, 6), (5.0, 7)])
def test_tables_of_a_noisy_measurement_are_accepted(noise_um, seed, small_machine, small_lengths_file, tmp_path):
    """The fit takes noise out of the identified curves; within their uncertainty that is no fault of the table."""
    scenario = compgen.read_scenario(small_lengths_file.parent / "scenario.toml")
    noisy = replace(scenario, instrument=replace(scenario.instrument, noise_um=noise_um))
    identified = compgen.identify(small_machine, compgen.simulate(small_machine, noisy, seed).lengths).errors
    files = export(small_machine, compgen.fit(small_machine, identified).errors, "siemens-cec").files
    result = judged(small_machine, identified, "siemens-cec", files, tmp_path)
    assert result.accepted, result.reasons
    assert result.after.rms_um < 0.1 * result.before.rms_um
