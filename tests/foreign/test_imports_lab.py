"""Sheets of laboratories: names of runs in several languages, statistics beside the runs, and what is never left out."""

from datetime import datetime

import numpy as np
import openpyxl
import pytest

from compgen.data.axis_runs import read_axis_runs
from compgen.data.lengths import Lengths
from compgen.errors import CompgenWarning, InputError
from compgen.foreign import ImportOptions, import_file, open_errors, open_measurement
from compgen.foreign.column_names import run_columns, statistic_in, way

#: One axis, worked by hand: deviations at three targets in two runs each way, um.
TARGETS_MM = (-800.0, -400.0, 0.0)
RUNS_UM = {(1, 1): (1.0, 2.0, 5.0), (1, -1): (3.0, 4.5, 7.5), (2, 1): (1.2, 2.1, 5.2), (2, -1): (3.1, 4.4, 7.6)}
ROUNDING_MM = 1e-12


def written(tmp_path, text, name="x.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text.encode(encoding))
    return path


def assert_is_the_example(data, runs_um=RUNS_UM, axis=0):
    """Every reading with its sign, unit, run and direction, and none else."""
    assert set(data.axis.tolist()) == {axis}
    found = {
        (run, way_of, target): value
        for run, way_of, target, value in zip(
            data.run.tolist(),
            data.direction.tolist(),
            data.position_mm.tolist(),
            data.deviation_mm.tolist(),
            strict=True,
        )
    }
    expected = {(*key, t): 1e-3 * v for key, values in runs_um.items() for t, v in zip(TARGETS_MM, values, strict=True)}
    assert len(data) == len(expected)
    assert found == pytest.approx(expected, abs=ROUNDING_MM)


def sheet(names, *, before="", after="", extra=(), separator=";", decimal=",", position="Position [mm]"):
    """Return a table with a column for each run; ``extra`` holds a name and one cell for each target."""
    lines = [separator.join([position, *names, *(name for name, _ in extra)])]
    for k, target in enumerate(TARGETS_MM):
        cells = [f"{target:g}", *(f"{values[k]:.1f}" for values in RUNS_UM.values()), *(cell[k] for _, cell in extra)]
        lines.append(separator.join(cell.replace(".", decimal) for cell in cells))
    return before + "\n".join(lines) + "\n" + after


#: The four runs as laboratories of several countries call them: run 1 forth and back, run 2 forth and back.
NAMES = {
    "german": ("Lauf 1 vor [µm]", "Lauf 1 zurück [µm]", "Lauf 2 vor [µm]", "Lauf 2 zurück [µm]"),
    "german ways": ("vorwärts 1", "rückwärts 1", "vorwärts 2", "rückwärts 2"),
    "hin und rück": ("1. Hinweg (µm)", "1. Rückweg (µm)", "2. Hinweg (µm)", "2. Rückweg (µm)"),
    "auf ab": ("M1 auf", "M1 ab", "M2 auf", "M2 ab"),
    "letters": ("V1", "R1", "V2", "R2"),
    "umlauts written out": (
        "Lauf_1_vorwaerts_um",
        "Lauf_1_rueckwaerts_um",
        "Lauf_2_vorwaerts_um",
        "Lauf_2_rueckwaerts_um",
    ),
    "english": ("Run 1 forward (um)", "Run 1 backward (um)", "Run 2 forward (um)", "Run 2 backward (um)"),
    "short": ("fwd1", "bwd1", "fwd2", "bwd2"),
    "up down": ("Run-1-up", "Run-1-down", "Run-2-up", "Run-2-down"),
    "signs": ("Run 1 +", "Run 1 \u2212", "Run 2 +", "Run 2 \u2212"),
    "positive": ("1 positive", "1 negative", "2 positive", "2 negative"),
    "arrows": ("j=1 \u2191", "j=1 \u2193", "j=2 \u2191", "j=2 \u2193"),
    "french": ("Aller n°1 (µm)", "Retour n°1 (µm)", "Aller n°2 (µm)", "Retour n°2 (µm)"),
    "italian": ("Andata 1", "Ritorno 1", "Andata 2", "Ritorno 2"),
    "spanish": ("Ida 1 [µm]", "Vuelta 1 [µm]", "Ida 2 [µm]", "Vuelta 2 [µm]"),
    "chinese": ("正向第1次(μm)", "反向第1次(μm)", "正向第2次(μm)", "反向第2次(μm)"),
}


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_runs_are_known_by_their_names_in_six_languages(tmp_path, names):
    options = ImportOptions(axis="X", sign="error", units={"deviation": "um"})
    item = import_file(written(tmp_path, sheet(names)), options)
    assert item.doubts == ()
    assert "not_used" not in item.understood
    assert_is_the_example(item.data)


@pytest.mark.parametrize(
    "extra",
    [
        ("Messung Nord [µm]", ("1,0", "2,0", "5,0")),
        ("Lauf 3 quer", ("1", "2", "5")),
        ("Kontrolle", ("1", "", "")),
        ("mean run 1", ("1", "2", "3")),
    ],
)
def test_no_column_of_numbers_is_left_out_without_a_word_of_the_user(tmp_path, extra):
    path = written(tmp_path, sheet(NAMES["german"], extra=[extra]))
    item = import_file(path, ImportOptions(axis="X", sign="error"))
    (doubt,) = item.doubts
    assert extra[0] in doubt
    assert f"--ignore {extra[0]!r}" in doubt
    assert "--map run1-=" in doubt
    left_out = import_file(path, ImportOptions(axis="X", sign="error", ignore=[extra[0]]))
    assert left_out.doubts == ()
    assert left_out.understood["not_used"] == {extra[0]: "excluded by --ignore"}
    assert_is_the_example(left_out.data)


def test_runs_whose_names_nobody_knows_are_said_by_the_user(tmp_path):
    path = written(tmp_path, sheet(("Messung Süd", "Messung Nord", "Süd zum zweiten", "Nord zum zweiten")))
    with pytest.raises(InputError, match=r"Messung Süd, Messung Nord.*--map run1\+=COLUMN"):
        import_file(path, ImportOptions(axis="X", sign="error"))
    columns = {"run1+": "Messung Süd", "run1-": "Messung Nord", "run2+": "Süd zum zweiten", "run2-": "Nord zum zweiten"}
    item = import_file(path, ImportOptions(axis="X", columns=columns, sign="error", units={"value": "um"}))
    assert item.doubts == ()
    assert_is_the_example(item.data)
    del columns["run2-"]
    assert (
        "'Nord zum zweiten' contains numbers"
        in import_file(path, ImportOptions(axis="X", columns=columns, sign="error")).doubts[0]
    )


def test_means_beside_the_runs_are_no_runs_and_are_held_against_them(tmp_path):
    means = [
        ("Mittel vor", ("1,10", "2,05", "5,10")),
        ("Mittel zurück", ("3,05", "4,45", "7,55")),
        ("s vor", ("0,14", "0,07", "0,14")),
        ("Umkehrspanne B", ("-1,95", "-2,40", "-2,45")),
        ("x\u0304 [mm]", ("0,0021", "0,0033", "0,0063")),
    ]
    options = ImportOptions(axis="X", sign="error")
    item = import_file(written(tmp_path, sheet(NAMES["german"], extra=means)), options)
    assert item.doubts == ()
    assert_is_the_example(item.data)
    assert sum("is a statistic over the runs" in note for note in item.notes) == 5
    wrong = [("Mittel zurück", ("3,05", "4,95", "7,55"))]
    item = import_file(written(tmp_path, sheet(NAMES["german"], extra=wrong)), options)
    assert "'Mittel zurück' states 4.95 in line 3" in item.doubts[0]
    assert "is 4.45: is a run missing" in item.doubts[0]


def test_two_columns_of_one_run_and_different_units_are_refused(tmp_path):
    twice = sheet(("Lauf 1 vor", "Run 1 fwd", "Lauf 2 vor", "Lauf 2 zurück"))
    with pytest.raises(InputError, match="'Lauf 1 vor' and 'Run 1 fwd' are the same run and direction"):
        import_file(written(tmp_path, twice))
    units = sheet(("Lauf 1 vor [µm]", "Lauf 1 zurück [mm]", "Lauf 2 vor", "Lauf 2 zurück"))
    with pytest.raises(InputError, match="different units.*'Lauf 1 zurück .mm.' mm"):
        import_file(written(tmp_path, units))


@pytest.mark.parametrize(
    ("header", "doubt"),
    [
        ("Soll [mm];Ist [mm];Abweichung [µm]", None),
        ("Soll [mm];Ist [mm];Korrektur [µm]", "'Korrektur [µm]' has the opposite sign of 'Ist [mm]' minus target"),
        # the readings are in mm, whatever their heading says; the deviations have more digits and are used
        ("Soll [mm];Ist [inch];Abweichung [µm]", None),
    ],
)
def test_deviations_beside_readings_are_held_against_them(tmp_path, header, doubt):
    rows = "0;0,0012;1,23\n100;100,0046;4,56\n200;199,9979;-2,11\n"
    item = import_file(written(tmp_path, f"{header}\n{rows}"), ImportOptions(axis="X"))
    assert len(item.doubts) == (doubt is not None)
    assert all(doubt in text for text in item.doubts)
    if doubt is None:
        np.testing.assert_allclose(item.data.deviation_mm, [1.23e-3, 4.56e-3, -2.11e-3], rtol=0, atol=ROUNDING_MM)
    wrong = rows.replace("-2,11", "-3,11")
    assert any(
        "disagrees" in text
        for text in import_file(written(tmp_path, f"{header}\n{wrong}"), ImportOptions(axis="X")).doubts
    )


def test_directions_may_be_part_of_the_number_of_the_run_or_of_the_axis(tmp_path):
    rows = [(t, v, n, w) for (n, w), values in RUNS_UM.items() for t, v in zip(TARGETS_MM, values, strict=True)]
    for name, cell in (("Lauf", "{n} vor|{n} zurück"), ("Run", "{n}+|{n}-")):
        ways = cell.split("|")
        lines = [f"{t},{v},{ways[w < 0].format(n=n)},X" for t, v, n, w in rows]
        text = f"Position [mm],Abweichung [µm],{name},axis\n" + "\n".join(lines) + "\n"
        item = import_file(written(tmp_path, text))
        assert item.doubts == ()
        assert_is_the_example(item.data)
        with pytest.raises(InputError, match="'2x' gives no direction"):
            import_file(written(tmp_path, text.replace(f",{ways[1].format(n=2)},", ",2x,")))
    lines = [f"{t},{v},{n},X{'+' if w > 0 else '-'}" for t, v, n, w in rows]
    item = import_file(written(tmp_path, "Position [mm],Abweichung [µm],run,axis\n" + "\n".join(lines) + "\n"))
    assert_is_the_example(item.data)


def test_names_with_a_word_that_is_not_known_are_neither_runs_nor_statistics_nor_directions():
    assert run_columns(["Dead path 1", "x1", "Force 2", "auf/ab", "Run 1 2"], []) == []
    assert [statistic_in(text) for text in ("mean run 1", "Xylophon", "X-Y")] == [None] * 3
    assert [way(text) for text in ("2", "0", "sideways", "mean +", "auf/ab", "")] == [None] * 6


#: Sheets as people type them; each holds the example, if not said otherwise. First encoding, then text.
SHEETS = {
    "temperature above": (
        "utf-8",
        "Temperatur [°C];20,4\nPosition [mm];Lauf 1 vor [µm];Lauf 1 zurück [µm];Lauf 2 vor [µm];Lauf 2 zurück [µm]\n"
        "-800;1,0;3,0;1,2;3,1\n-400;2,0;4,5;2,1;4,4\n0;5,0;7,5;5,2;7,6\n",
    ),
    "quoted english header": (
        "utf-8",
        '"Machine:","VMC 850"\n"Air temperature (C):","20.84"\n"Operator:","J. Smith"\n"Date:","2024-03-18"\n\n'
        '"Target (mm)","Deviation (um)","Direction","Run"\n'
        + "".join(
            f'"{t}","{v}","{"Forward" if w > 0 else "Reverse"}","{n}"\n'
            for (n, w), values in RUNS_UM.items()
            for t, v in zip(TARGETS_MM, values, strict=True)
        ),
    ),
    "two columns, temperature above": (
        "cp1252",
        "Prüfprotokoll Positionierabweichung X-Achse\nPrüfer;Müller\nTemperatur [°C];20,4\nLaser Seriennummer;7H-2231\n"
        "Lauf 1 vor\nPosition;Abweichung [µm]\n-800;1,0\n-400;2,0\n0;5,0\n",
    ),
    "two lines of names": (
        "utf-16",
        "Positionsabweichung\t\t\t\t\n\tLauf 1\t\tLauf 2\t\n"
        "Position [mm]\tvor\tzurück\tvor\tzurück\n\tµm\tµm\tµm\tµm\n"
        "-800,000\t1,0\t3,0\t1,2\t3,1\n-400,000\t2,0\t4,5\t2,1\t4,4\n0,000\t5,0\t7,5\t5,2\t7,6\n",
    ),
    "directions over numbers of runs": (
        "utf-8",
        "Ecart de position (µm);;;;\n;Aller;;Retour;\nPosition (mm);1;2;1;2\n"
        "-800;1,0;1,2;3,0;3,1\n-400;2,0;2,1;4,5;4,4\n0;5,0;5,2;7,5;7,6\n",
    ),
    "signs under units": (
        "utf-8",
        "Deviation,Run 1,,Run 2,\nTarget,+,-,+,-\n"
        "mm,um,um,um,um\n-800,1.0,3.0,1.2,3.1\n-400,2.0,4.5,2.1,4.4\n0,5.0,7.5,5.2,7.6\n",
    ),
    "ways repeated": (
        "utf-8",
        "Abweichung in µm\nPosition [mm];vor [µm];zurück [µm];vor [µm];zurück [µm]\n"
        "-800;1,0;3,0;1,2;3,1\n-400;2,0;4,5;2,1;4,4\n0;5,0;7,5;5,2;7,6\n",
    ),
    "targets across, rows of runs": (
        "utf-8",
        "Abweichungen [µm]\nPosition [mm];-800;-400;0\nLauf 1 vor;1,0;2,0;5,0\nLauf 1 zurück;3,0;4,5;7,5\n"
        "Lauf 2 vor;1,2;2,1;5,2\nLauf 2 zurück;3,1;4,4;7,6\n",
    ),
    "targets across, run and direction in cells": (
        "utf-8",
        "Deviation (um)\nRun,Direction,-800,-400,0\n1,+,1.0,2.0,5.0\n1,-,3.0,4.5,7.5\n2,+,1.2,2.1,5.2\n2,-,3.1,4.4,7.6\n"
        "Mean,,2.08,3.25,6.33\n",
    ),
    "ISO form, arrows": (
        "utf-8",
        "ISO 230-2 deviation, um\ni,1,2,3\nTarget position (mm),-800,-400,0\nj=1 ↑,1.0,2.0,5.0\nj=1 ↓,3.0,4.5,7.5\n"
        "j=2 ↑,1.2,2.1,5.2\nj=2 ↓,3.1,4.4,7.6\nMean ↑,1.10,2.05,5.10\nMean ↓,3.05,4.45,7.55\ns ↑,0.14,0.07,0.14\n",
    ),
    "means and remarks below": (
        "utf-8",
        "Fehler\nSoll [mm];V1 [µm];R1 [µm];V2 [µm];R2 [µm];Mittelwert\n-800;1,0;3,0;1,2;3,1;2,08\n-400;2,0;4,5;2,1;4,4;3,25\n"
        "0;5,0;7,5;5,2;7,6;6,33\nMittelwert;2,67;5,00;2,83;5,03;3,88\nMax;5,0;7,5;5,2;7,6;6,33\nMaschine war 2 h warm\n",
    ),
    "results below, a table of their own": (
        "utf-8",
        "Errore di posizionamento [µm]\nPosizione [mm];Andata 1;Ritorno 1;Andata 2;Ritorno 2\n-800;1,0;3,0;1,2;3,1\n"
        "-400;2,0;4,5;2,1;4,4\n0;5,0;7,5;5,2;7,6\n\nPosizione [mm];Media andata;Media ritorno;Isteresi\n-800;1,10;3,05;-1,95\n"
        "-400;2,05;4,45;-2,40\n0;5,10;7,55;-2,45\n\nPrecisione A;9,1\n",
    ),
    "empty columns": (
        "utf-8",
        ";;;;;;;\n;Error de posición;;;;;;\n;Posición [mm];;Ida 1 [µm];Vuelta 1 [µm];;Ida 2 [µm];Vuelta 2 [µm]\n"
        ";-800;;1,0;3,0;;1,2;3,1\n;-400;;2,0;4,5;;2,1;4,4\n;0;;5,0;7,5;;5,2;7,6\n",
    ),
    "chinese": (
        "utf-8",
        "定位误差 (μm)\n目标位置(mm),正向1,反向1,正向2,反向2\n-800,1.0,3.0,1.2,3.1\n-400,2.0,4.5,2.1,4.4\n0,5.0,7.5,5.2,7.6\n",
    ),
    "millimetres": (
        "utf-8",
        "Position [mm];Run 1 fwd dev [mm];Run 1 bwd dev [mm];Run 2 fwd dev [mm];Run 2 bwd dev [mm]\n"
        "-800;0,0010;0,0030;0,0012;0,0031\n-400;0,0020;0,0045;0,0021;0,0044\n0;0,0050;0,0075;0,0052;0,0076\n",
    ),
    "readings": (
        "utf-8",
        "Soll [mm];Ist 1 vor [mm];Ist 1 zurück [mm];Ist 2 vor [mm];Ist 2 zurück [mm]\n"
        "-800;-799,9990;-799,9970;-799,9988;-799,9969\n-400;-399,9980;-399,9955;-399,9979;-399,9956\n0;0,0050;0,0075;0,0052;0,0076\n",
    ),
    "readings and deviations": (
        "utf-8",
        "Nr.;Soll [mm];Ist [mm];Abweichung [µm];Richtung;Lauf\n"
        + "".join(
            f"{k};{t:g};{t + v / 1000:.4f};{v:.1f};{'vorwärts' if w > 0 else 'rückwärts'};{n}\n"
            for k, (n, w, t, v) in enumerate(
                ((n, w, t, v) for (n, w), values in RUNS_UM.items() for t, v in zip(TARGETS_MM, values, strict=True)),
                start=1,
            )
        ).replace(".", ","),
    ),
    "start and end of the temperatures": (
        "utf-8",
        "Deviation\nAir temperature [°C];20.1;20.3\nMaterial temperature 1 [°C];20.0;20.2\n"
        "Material temperature 2 [°C];20.0;20.2\nAir pressure [hPa];1012;1013\n"
        "Position [mm];Run 1 +;Run 1 -;Run 2 +;Run 2 -\n-800;1.0;3.0;1.2;3.1\n-400;2.0;4.5;2.1;4.4\n"
        "0;5.0;7.5;5.2;7.6\n",
    ),
    "one axis by its letter": (
        "utf-8",
        "X [mm],dX [um],Direction,Run\n"
        + "".join(
            f"{t},{v},{w:+d},{n}\n"
            for (n, w), values in RUNS_UM.items()
            for t, v in zip(TARGETS_MM, values, strict=True)
        ),
    ),
}
ONE_RUN = {(1, 1): RUNS_UM[1, 1]}


@pytest.mark.parametrize("name", SHEETS)
def test_sheets_of_laboratories_come_out_as_a_person_reads_them(tmp_path, name):
    encoding, text = SHEETS[name]
    path = written(tmp_path, text, encoding=encoding)
    item = import_file(
        path, ImportOptions(axis="X", units={"deviation": "um"} if "unit" not in text and "m" not in text else {})
    )
    assert item.doubts == ()
    one_run = name == "two columns, temperature above"
    assert_is_the_example(item.data, ONE_RUN if one_run else RUNS_UM)


GERMAN_HEAD = """\
Messprotokoll Positionierabweichung X-Achse;;;;
Datum;12.03.2024;;;
Prüfer;Jürgen Müller;;;
Messgerät:;XL-80;Seriennummer:;A123;
Lufttemperatur [°C];20,4;20,6;;
Ausdehnungskoeffizient;11,5 µm/m/K;;;
# u_deviation_um = 0,4;;;;
# reference_point_mm = -800;0;0;;
"""


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "cp1252"])
def test_what_stands_above_the_table_and_its_comments_are_kept(tmp_path, encoding):
    path = written(tmp_path, GERMAN_HEAD + sheet(NAMES["german"]), "run.csv", encoding)
    item = import_file(path)
    assert item.doubts == ()
    assert_is_the_example(item.data)
    expected = {
        "operator": "Jürgen Müller",
        "instrument": "XL-80",
        "serial_number": "A123",
        "temp_ambient_c": "20.5",
        "material_expansion_um_per_m_k": "11.5",
        "u_deviation_um": "0.4",
        "reference_point_mm": "-800, 0, 0",
        "measured_at": "2024-03-12",
        "date": "2024-03-12",
        "source": "run.csv",
    }
    assert item.data.metadata == expected
    out = written(tmp_path, item.files()["run.axis.csv"], "run.axis.csv")
    assert read_axis_runs(out).metadata == expected


@pytest.mark.parametrize(
    ("line", "kept"),
    [
        ("Temperature;20.4 °C", {"temp_measured_c": "20.4"}),
        ("Air temp [°F];68", {"temp_ambient_c": "20"}),
        ("Température de l'air;20,0;20,4;°C", {"temp_ambient_c": "20.2"}),
        ("Temperatur [°C];18;24", {}),  # of beginning and end, too far apart to be one number
        ("Temperatur;68", {"temp_measured_c": "20"}),
        ("Temperature [K];20", {}),
        ("CTE;1.15e-5 1/K", {"material_expansion_um_per_m_k": "11.5"}),
        ("SN;4711", {"serial_number": "4711"}),
    ],
)
def test_lines_above_a_table_are_kept_where_they_are_clear(tmp_path, line, kept):
    item = import_file(written(tmp_path, f"{line}\n" + sheet(NAMES["german"])), ImportOptions(axis="X"))
    assert {key: value for key, value in item.data.metadata.items() if key != "source"} == kept


def test_comments_of_own_files_survive_semicolons_and_utf_16_and_cut_ones_are_seen(tmp_path):
    text = (
        "# u_length_um = 0.2\n# rows = 3\nstation,point,x_mm,y_mm,z_mm,length_mm\n"
        "A,1,0,0,0,100.5\nA,2,100,0,0,190.5\nA,3,100,90,0,260.5\n"
    )
    for name, other, encoding in (
        ("a.csv", text, "utf-16"),
        ("b.csv", text.replace(",", ";").replace(".", ","), "utf-8"),
        ("c.csv", text.replace(",", "\t"), "cp1252"),
    ):
        item = import_file(written(tmp_path, other, name, encoding))
        assert isinstance(item.data, Lengths)
        assert item.data.metadata["u_length_um"] == "0.2"
        assert item.data.length_mm.tolist() == [100.5, 190.5, 260.5]
    with pytest.raises(InputError, match="declares '3' rows but contains 2: is it truncated"):
        import_file(written(tmp_path, text.rpartition("A,3")[0].replace(",", ";"), "d.csv"))


def test_the_axis_is_known_by_the_title_and_asked_for_where_the_name_of_the_file_differs(tmp_path):
    for title in ("Positionierung der Y-Achse", "Achse: Y", "Asse Y", "Y轴定位精度", "Axis;Y1"):
        text = f"{title}\n{sheet(NAMES['german'])}"
        assert (
            import_file(written(tmp_path, text))
            .doubts[0]
            .startswith("the lines above the table give axis Y, but the sheet or file is")
        )
        assert_is_the_example(import_file(written(tmp_path, text, "measured.csv")).data, axis=1)


def test_a_missing_column_of_directions_is_named_as_such(tmp_path):
    rows = [(t, v, n) for (n, _), values in RUNS_UM.items() for t, v in zip(TARGETS_MM, values, strict=True)]
    by_target = "".join(f"{t},{v},{n}\n" for t, v, n in sorted(rows))
    item = import_file(written(tmp_path, f"position [mm],deviation [um],run\n{by_target}"), ImportOptions(axis="X"))
    assert "there is no column of directions (the header has 'position [mm], deviation [um], run')" in item.doubts[0]
    assert "--map direction=COLUMN" in item.doubts[0]
    forth_and_back = "".join(
        f"{t},{v},{n}\n"
        for (n, w), values in RUNS_UM.items()
        for t, v in list(zip(TARGETS_MM, values, strict=True))[::w]
    )
    item = import_file(
        written(tmp_path, f"position [mm],deviation [um],run\n{forth_and_back}"), ImportOptions(axis="X")
    )
    assert item.doubts == ()
    assert_is_the_example(item.data)


def test_messages_keep_umlauts_and_signs_and_escape_what_commands_a_terminal(tmp_path):
    with pytest.raises(InputError, match="column Größe .µm.: 'groß' is not a number"):
        import_file(
            written(tmp_path, "Position [mm];Größe [µm]\n0;1\n1;groß\n"),
            ImportOptions(columns={"deviation": "Größe [µm]"}),
        )
    with pytest.raises(InputError, match=r"'\\x1b\[2J' is not a number"):
        import_file(written(tmp_path, "Position [mm];Fehler [µm]\n0;1\n1;\x1b[2J\n"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "Position;Fehler [µm]\n0;1\n100;2\n\nPosition;x;y\n0;1;2\n100;3;4\n",
            ":2: these rows of numbers do not belong",
        ),
        ("Position;vor 1;vor 2\n0;1;1\n100;2;2\nPosition;Fehler\n0;1\n", "'Position' is not a number|rows of numbers"),
        (
            "vor\n0;1\n100;2\n200;3\n\nPosition;Fehler\n0;1\n100;2\n200;3\n300;4\n",
            "these rows of numbers do not belong",
        ),
        (
            "Fehler vor;;\nPosition;1;2\n0;1;1\n100;2;2\nFehler zurück;;\nPosition;1;2\n0;3;3\n100;4;4\n",
            "rows of numbers",
        ),
        ("Position;vor;hoppla\n0;1;1;7\n100;2;2;7\n", "contains no table"),
    ],
)
def test_a_second_block_of_numbers_is_never_left_out(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        import_file(written(tmp_path, text), ImportOptions(axis="X"))


def workbook(tmp_path, sheets, name="lab.xlsx"):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets.items():
        own = book.create_sheet(title)
        for row in rows:
            own.append(row)
    book.save(tmp_path / name)
    return tmp_path / name


def axis_sheet(*before):
    rows = [[t, *(values[k] for values in RUNS_UM.values())] for k, t in enumerate(TARGETS_MM)]
    return [*before, ["Position [mm]", *NAMES["german"]], *rows]


def test_a_row_with_a_number_above_a_sheet_and_an_empty_margin(tmp_path):
    rows = axis_sheet(["Temperatur", 20.4, "°C"], ["Datum", datetime(2024, 3, 12), None], [])
    shifted = [[], *([None, None, *row] for row in rows), [], [None, None, "Mittelwert", 2.67, 5.0, 2.83, 5.03]]
    for number, own in enumerate((rows, shifted)):
        item = import_file(workbook(tmp_path, {"X": own}, f"{number}.xlsx"))
        assert item.doubts == ()
        assert_is_the_example(item.data)
        assert item.data.metadata["temp_measured_c"] == "20.4"
        assert item.data.metadata["measured_at"].startswith("2024-03-12")


@pytest.mark.parametrize(
    ("rows", "expected_urad"),
    [
        ([["EC0Y", 25, "µrad"]], {"EC0Y": 25.0}),
        ([["Squareness", "Value [arcsec]"], ["EC0Y", 2.0], ["EB0Z", -1.0]], {"EC0Y": 9.6962736, "EB0Z": -4.8481368}),
        ([["Error", "µm/m"], ["E_C0Y", -12.5], ["EA0Z", 3]], {"EC0Y": -12.5, "EA0Z": 3.0}),
        # +Y leans to -X where EC0Y > 0: the angle is more than 90 degrees; +Z leans to +X where EB0Z > 0
        ([["X-Y", 90.001, "°"], ["X-Z", 90.001, "°"]], {"EC0Y": 17.4532925, "EB0Z": -17.4532925}),
    ],
)
def test_a_sheet_of_squareness_beside_sheets_of_axes(tmp_path, rows, expected_urad):
    path = workbook(tmp_path, {"X": axis_sheet(), "Y": axis_sheet(), "Squareness": rows, "Info": [["made by", "hand"]]})
    item = import_file(path)
    assert item.doubts == ()
    assert item.data.axes == (0, 1)
    found = {name: 1e6 * value for name, (value, _) in item.other_errors.squareness.items()}
    assert found == pytest.approx(expected_urad, abs=1e-6)
    assert set(item.files()) == {"lab.axis.csv", "lab.errors.csv"}
    with pytest.warns(CompgenWarning, match="was read as"):
        (_, runs), (name, errors) = open_measurement([path]).parts
    assert (runs.axes, name) == ((0, 1), "lab.xlsx (errors)")
    assert {name: 1e6 * value for name, (value, _) in errors.squareness.items()} == pytest.approx(
        expected_urad, abs=1e-6
    )
    with pytest.warns(CompgenWarning), pytest.raises(InputError, match="contains runs of axes and errors as well .E"):
        open_errors(path)
    alone = import_file(path, ImportOptions(ignore=["Squareness"]))
    assert alone.other_errors is None
    assert len(alone.data) == 24


@pytest.mark.parametrize(
    ("rows", "doubt"),
    [
        ([["XY", 25, "µrad"]], "the sign of 'XY' is not clear (EC0Y > 0"),
        ([["EC0Y", 25]], "no unit of 'EC0Y'"),
        ([["Rechtwinkligkeit"], ["Spindel", 25, "µm"]], "'Squareness' contains numbers that are not understood"),
        ([["a", "b"], ["c", 1, 2, 3], ["d", 4, 5, 6]], "'Squareness' contains numbers that are not understood"),
    ],
)
def test_a_sheet_that_is_not_understood_is_asked_for(tmp_path, rows, doubt):
    path = workbook(tmp_path, {"X": axis_sheet(), "Squareness": rows})
    assert any(doubt in text for text in import_file(path).doubts)
    with pytest.raises(InputError, match="leaves open"):
        open_measurement([path])
    alone = import_file(path, ImportOptions(ignore=["Squareness"]))
    assert alone.doubts == ()
    assert_is_the_example(alone.data)
    with pytest.raises(InputError, match="there is no column or sheet 'Rechteck'"):
        import_file(path, ImportOptions(ignore=["Squareness", "Rechteck"]))


def test_a_sheet_of_statistics_is_left_out_and_one_of_mean_errors_is_held_against_the_runs(tmp_path):
    results = [["Parameter", "vor", "zurück"], ["Umkehrspanne B", 2.4, 2.4], ["Wiederholpräzision R", 0.4, 0.3]]
    item = import_file(workbook(tmp_path, {"X": axis_sheet(), "Ergebnis": results}))
    assert item.doubts == ()
    assert any("sheet skipped: 'Ergebnis'" in note for note in item.notes)
    means = [["Position [mm]", "EXX [µm]", "EYX [µm]"], [-800, 2.075, 0.5], [-400, 3.25, 1], [0, 6.325, 0]]
    path = workbook(tmp_path, {"X": axis_sheet(), "Mittel": means})
    (doubt,) = import_file(path).doubts
    assert "contains EXX, and the runs of X give it, too (their means differ by up to " in doubt
    assert float(doubt.partition("up to ")[2].split()[0]) < 1e-6
    straight = workbook(tmp_path, {"X": axis_sheet(), "Geradheit": [[row[0], row[2]] for row in means]})
    item = import_file(straight)
    assert item.doubts == ()
    assert item.other_errors.curves["EYX"].value.tolist() == pytest.approx([5e-4, 1e-3, 0], abs=ROUNDING_MM)


MORE = {
    "signs behind the unit": ("utf-8", "X-Achse\nPosition [mm];Abw. 1 [µm] +;Abw. 1 [µm] -;Abw. 2 [µm] +;Abw. 2 [µm] -;"
                              "Feuchte [%]\n"
                              "-800;1,0;3,0;1,2;3,1;45\n-400;2,0;4,5;2,1;4,4;45\n0;5,0;7,5;5,2;7,6;46\n"),
    "blank lines between the rows": ("utf-8", "X-Achse Abweichung\nPos [mm]\tL1+\tL1-\tL2+\tL2-\n\n-800\t1\t3\t1.2\t3.1\n\n"
                                     "-400\t2\t4.5\t2.1\t4.4\n\n0\t5\t7.5\t5.2\t7.6\n"),
    "chinese code page": ("gbk", "X轴 定位误差 (um)\n目标位置 mm,-800,-400,0\n正向 1,1,2,5\n反向 1,3,4.5,7.5\n"
                          "正向 2,1.2,2.1,5.2\n反向 2,3.1,4.4,7.6\n"),
    "rows of directions": ("utf-8", "Axis,X\nDeviation (um)\nDirection,-800,-400,0\nfwd,1,2,5\nrev,3,4.5,7.5\n"
                           "fwd,1.2,2.1,5.2\nrev,3.1,4.4,7.6\n"),
    "capitals": ("cp1252", "ACHSE X ABWEICHUNG\nPOSITION [MM];LAUF 1 VOR [µM];LAUF 1 ZURÜCK [µM];"
                 "LAUF 2 VOR [µM];LAUF 2 ZURÜCK [µM]\n"
                 "-800;1,0;3,0;1,2;3,1\n-400;2,0;4,5;2,1;4,4\n0;5,0;7,5;5,2;7,6\n"),
    "unit in the title": ("utf-8", "Eje X, desviación en mm\nPosición (mm);-800;-400;0\nIda 1;0,0010;0,0020;0,0050\n"
                          "Vuelta 1;0,0030;0,0045;0,0075\nIda 2;0,0012;0,0021;0,0052\nVuelta 2;0,0031;0,0044;0,0076\n"
                          "Media;0,0021;0,0032;0,0063\n"),
    "back before forth": ("utf-8", "Asse X\nQuota [mm];Scarto ritorno 1 [µm];Scarto andata 1 [µm];"
                          "Scarto ritorno 2 [µm];Scarto andata 2 [µm]\n"
                          "-800;3,0;1,0;3,1;1,2\n-400;4,5;2,0;4,4;2,1\n0;7,5;5,0;7,6;5,2\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", MORE)
def test_further_sheets_without_any_option(tmp_path, name):
    encoding, text = MORE[name]
    item = import_file(written(tmp_path, text, "t.csv", encoding))
    assert item.doubts == ()
    assert_is_the_example(item.data)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("X-Achse\nPosition [mm];Mittel vor [µm];Mittel zurück [µm]\n-800;1;3\n0;5;7\n", "no deviations or readings"),
        (
            "X-Achse\nvor;;;rück;\nPosition [mm];Fehler [µm];;Position [mm];Fehler [µm]\n-800;1,0;;-800;3,0\n0;5,0;;0;7,5\n",
            "twice",
        ),
        (
            "X-Achse\nPosition [mm];Abweichung [µm]\nvor\n-800;1,0\n0;5,0\nrück\n0;7,5\n-800;3,0\n",
            "no table|no row|not a number",
        ),
        ("Kompensation X-Achse\nPosition [mm];vor [µm];zurück [µm]\n-800;1;3\n0;5;7\n", "--sign"),
        ("X axis error\nPosition [mm];Run 1 fwd;Run 1 rtrn\n-800;1;3\n0;5;7.5\n", "'Run 1 rtrn' contains numbers"),
        ("X-Achse\nPosition [mm];X vor [µm];Y vor [µm]\n-800;1;3\n0;5;7\n", "no deviations or readings"),
        ("X-Achse Fehler\nPosition [mm];vor [µm];zurück [µm]\n-800;1;3\n0;5;\n;;9\n", "is empty|not a number"),
    ],
)
def test_what_a_person_would_ask_about_is_asked(tmp_path, text, what):
    path = written(tmp_path, text, "t.csv")
    with pytest.raises(InputError, match=what):
        open_measurement([path])


def test_runs_without_a_direction_that_differ_like_two_directions_are_asked_for(tmp_path):
    path = written(tmp_path, sheet([f"Run {k}" for k in (1, 2, 3, 4)]))
    (doubt,) = import_file(path, ImportOptions(axis="X")).doubts
    assert "--directions alternate" in doubt
    item = import_file(path, ImportOptions(axis="X", directions="alternate"))
    assert item.doubts == ()
    assert_is_the_example(item.data)
    alike = "Position [mm];Run 1;Run 2;Run 3;Run 4\n-800;1,0;1,2;1,3;1,1\n-400;2,2;2,0;2,1;2,2\n0;5,1;5,2;5,0;5,1\n"
    item = import_file(written(tmp_path, alike), ImportOptions(axis="X"))
    assert item.doubts == ()
    assert any("no run gives a direction" in note for note in item.notes)
    assert item.data.direction.tolist() == [1] * 12


def test_a_single_target_and_empty_runs_are_answered(tmp_path):
    item = import_file(written(tmp_path, "X-Achse Fehler\nPosition [mm];vor [µm];zurück [µm]\n0;5,0;7,5\n", "t.csv"))
    assert item.data.deviation_mm.tolist() == [0.005, 0.0075]
    with pytest.raises(InputError, match="the columns of the runs are empty"):
        import_file(written(tmp_path, "X-Achse Fehler\nPosition [mm];Nr;vor [µm]\n0;1;\n9;2;\n", "t.csv"))
