"""A report that can be handed over: what files and certificate.toml name is on it, what nobody stated is listed, not invented."""

import base64
import hashlib
import json
import re

import openpyxl
import pytest

from compgen.cli import cli
from compgen.errors import InputError
from compgen.foreign.heads import heads_of
from compgen.report.dcc import read_certificate, read_dcc
from compgen.report.dcc.reading import is_unchanged
from compgen.report.handover import handed_over
from compgen.report.html.write import certificate_copies, css_string, running_text
from compgen.report.pdf import browser, pdf_of

# a foreign file is said to be read as what it is, with a warning
pytestmark = pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")

HEAD = (
    "Messlabor Müller GmbH, Ulm",
    "Messprotokoll  Nr. 12345",
    "Kunde: Muster <AG>, Aalen",
    "Auftrag: A-2026/77",
    "Maschine: C30   Maschinen-Nr.: 4711",
    "Laser: XL-80   Seriennummer: 99AZ12",
    "Bediener: K. Huber",
    "Datum: 12.03.2026",
    "Achse: X",
    "Temperatur 20,1 20,3 °C",
)
ROWS = [(0, 0.0, 0.1), (-200, 1.0, 1.2), (-400, 2.0, 2.1), (-600, 2.9, 3.0), (-800, 4.2, 4.1)]
CERTIFICATE = """
[certificate]
order = "A-2026/78"
place = "Halle 4"
[customer]
name = "Muster Werkzeugbau"
city = "Aalen"
[[equipment]]
name = "XL-80"
serial_number = "99AZ12"
certificate_number = "D-K-1 2026-03"
[[equipment]]
name = "Level"
serial_number = "L7"
[conditions]
air_temperature_c = [19.8, 20.6]
"""


def call(*words):
    return cli.main([str(word) for word in words], standalone_mode=False)


@pytest.fixture(scope="module")
def lab_sheet(tmp_path_factory):
    path = tmp_path_factory.mktemp("lab") / "sheet.txt"
    rows = [";".join(f"{value}".replace(".", ",") for value in row) for row in ROWS]
    lines = [*HEAD, "", "Position [mm];Lauf 1 [µm];Lauf 2 [µm]", *rows, "", "Unsicherheit: U = 1,2 µm, k = 2"]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def ran(lab_sheet, tmp_path_factory):
    folder = tmp_path_factory.mktemp("handed")
    stated = folder / "mine.toml"
    stated.write_text(CERTIFICATE)
    out = folder / "out"
    call("run", "zha-gantry", lab_sheet, "--controller", "siemens-cec", "--out", out, "--certificate", stated)
    return out


def test_every_line_of_a_lab_sheet_that_is_no_reading_is_kept(lab_sheet):
    (head,) = heads_of([lab_sheet])
    plain = {re.sub(r"\s{2,}", "; ", line) for line in HEAD}
    assert plain <= set(head.lines)
    assert "Unsicherheit: U = 1,2 µm, k = 2" in head.lines
    assert len(head.lines) == len(HEAD) + 1  # no names of columns, no row of numbers
    assert head.stated == {
        "customer": "Muster <AG>, Aalen", "order_number": "A-2026/77", "certificate_number": "12345", "instrument": "XL-80",
        "serial_number": "99AZ12", "operator": "K. Huber", "machine_serial_number": "4711",
    }  # fmt: skip


def test_a_workbook_says_the_same_as_the_text(lab_sheet, tmp_path):
    book = openpyxl.Workbook()
    for line in HEAD:
        book.active.append([part for pair in re.split(r"\s{2,}", line) for part in pair.split(": ")])
    book.active.append([])
    for row in (("Position [mm]", "Lauf 1 [µm]", "Lauf 2 [µm]"), *ROWS):
        book.active.append(list(row))
    path = tmp_path / "sheet.xlsx"
    book.save(path)
    (head,), (text,) = heads_of([path]), heads_of([lab_sheet])
    same = ("customer", "order_number", "operator", "certificate_number")
    assert {key: head.stated.get(key) for key in same} == {key: text.stated[key] for key in same}
    assert not any("Lauf" in line or "-200" in line for line in head.lines)


def test_an_import_keeps_what_the_file_said(lab_sheet, tmp_path):
    call("import", lab_sheet, "--out", tmp_path)
    (native,) = tmp_path.glob("*.csv")
    (before,), (after,) = heads_of([lab_sheet]), heads_of([native])
    assert set(before.lines) <= set(after.lines)
    assert before.stated.items() <= after.stated.items()


def test_the_report_names_customer_order_place_instruments_and_the_lines_of_the_files(ran):
    page = (ran / "report.html").read_text("utf-8")
    for text in ("Muster Werkzeugbau, Aalen", "A-2026/78", "Halle 4", "4711", "D-K-1 2026-03", "L7", "19.8 to 20.6 °C",
                 "Messprotokoll; Nr. 12345", "Kunde: Muster &lt;AG&gt;, Aalen", "A-2026/77"):  # fmt: skip
        assert text in page, text
    assert "<AG>" not in page
    data = json.loads((ran / "report.json").read_text("utf-8"))["handover"]
    # the laser of the file and that of the certificate are the same instrument: the same serial number
    assert [(item["serial_number"], item["certificate"], item["file"]) for item in data["instruments"]] == [
        ("99AZ12", "D-K-1 2026-03", "sheet.txt"),
        ("L7", "", ""),
    ]
    assert {item["what"] for item in data["missing"]} == {"Laboratory", "Machine maker"} - {
        item["heading"] for item in data["facts"] if item["text"]
    }


def test_a_copy_of_the_certificate_makes_the_same_report_again_and_an_incomplete_one_no_dcc(ran, capsys):
    first = (ran / "report.html").read_text("utf-8")
    call("report", ran)
    assert (ran / "report.html").read_text("utf-8") == first
    assert not (ran / "dcc.xml").exists()
    assert "no dcc.xml" in capsys.readouterr().out


def test_an_axis_whose_positioning_was_not_measured_has_no_figure(ran):
    groups = json.loads((ran / "report.json").read_text("utf-8"))["accuracy"]["groups"]
    assert [row["key"] for group in groups for row in group["rows"]] == ["M_X"]


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("[customer]\nnmae = 'x'\n", "nmae"),
        ("[certificate]\nbegin = 2026-03-02\nend = 2026-03-01\n", "end"),
        ("[conditions]\nair_temperature_c = 400\n", "air_temperature_c"),
    ],
)
def test_a_wrong_certificate_is_refused_before_the_work_begins(text, field, lab_sheet, tmp_path, capsys):
    (tmp_path / "c.toml").write_text(text)
    words = ["run", "zha-gantry", lab_sheet, "--controller", "siemens-cec", "--certificate", tmp_path / "c.toml"]
    with pytest.raises(InputError, match=field):
        call(*words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_of_nothing_stated_everything_is_missing_and_nothing_invented():
    data = handed_over(None, [], {})
    assert not any(item["text"] for item in data["facts"])
    assert len(data["missing"]) == len(data["facts"]) + 3
    assert data["instruments"] == data["conditions"] == data["persons"] == []


def test_no_text_ends_the_style_that_it_is_written_into():
    hostile = "a\"}</style><script>\\u{1}'"
    assert not re.search(r"[\"'<>{}]", css_string(hostile))
    facts = [{"heading": "Certificate number", "text": "7"}]
    assert running_text({"title": "m", "handover": {"facts": facts}, "provenance": {"date": None}}) == "m  7"


@pytest.mark.skipif(browser() is None, reason="no browser that prints")
def test_the_page_is_printed_with_numbered_pages(ran):
    made = pdf_of(ran / "report.html")
    assert made.startswith(b"%PDF")


# The DCC of an instrument, as its laboratory issued it.

LASER = """<?xml version="1.0" encoding="UTF-8"?>
<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si" schemaVersion="3.2.1">
<dcc:administrativeData><dcc:coreData><dcc:uniqueIdentifier>D-K-15142-01-00 2026-03</dcc:uniqueIdentifier>
<dcc:beginPerformanceDate>2026-02-27</dcc:beginPerformanceDate>
<dcc:endPerformanceDate>2026-03-02</dcc:endPerformanceDate></dcc:coreData>
<dcc:items><dcc:item><dcc:name><dcc:content>Laser</dcc:content></dcc:name><dcc:identifications><dcc:identification>
<dcc:issuer>manufacturer</dcc:issuer><dcc:value>99AZ12</dcc:value></dcc:identification></dcc:identifications></dcc:item></dcc:items>
<dcc:calibrationLaboratory><dcc:contact><dcc:name><dcc:content>Kalibrierlabor Nord</dcc:content></dcc:name></dcc:contact>
</dcc:calibrationLaboratory></dcc:administrativeData>
<dcc:measurementResults><dcc:measurementResult><dcc:results><dcc:result><dcc:data><dcc:list>
<dcc:quantity><si:realListXMLList><si:valueXMLList>0 500 1000</si:valueXMLList><si:unitXMLList>\\milli\\metre</si:unitXMLList>
</si:realListXMLList></dcc:quantity>
<dcc:quantity><si:realListXMLList><si:valueXMLList>0.0 0.2 -0.1</si:valueXMLList><si:unitXMLList>\\micro\\metre</si:unitXMLList>
<si:expandedUncXMLList><si:uncertaintyXMLList>0.1 0.2 0.3</si:uncertaintyXMLList>
<si:coverageFactorXMLList>2</si:coverageFactorXMLList>
</si:expandedUncXMLList></si:realListXMLList></dcc:quantity></dcc:list></dcc:data></dcc:result></dcc:results></dcc:measurementResult>
</dcc:measurementResults></dcc:digitalCalibrationCertificate>
"""


def with_laser(folder, text=LASER, **stated):
    (folder / "laser.xml").write_text(text)
    lines = [
        f'{key} = "{value}"' for key, value in {"name": "XL-80", "certificate_file": "laser.xml", **stated}.items()
    ]
    path = folder / "certificate.toml"
    path.write_text("[[equipment]]\n" + "\n".join(lines) + "\n")
    return path


def test_the_dcc_of_an_instrument_gives_number_laboratory_and_day(tmp_path):
    path = with_laser(tmp_path, serial_number="99AZ12")
    (thing,) = read_certificate(path, complete=False).equipment
    assert (thing.certificate_number, thing.certificate_by) == (
        "D-K-15142-01-00 2026-03",
        "Kalibrierlabor Nord, measured 2026-03-02",
    )
    assert thing.certificate_sha256 == hashlib.sha256((tmp_path / "laser.xml").read_bytes()).hexdigest()
    assert set(certificate_copies(path)) == {"certificate.toml", "laser.xml"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.1 0.2 0.3", "0.1 0.2", "3 values, but 2 of uncertaintyXMLList"),
        ("0.1 0.2 0.3", "0.1 -0.2 0.3", "below 0"),
        (">2<", ">0.5<", "below 1"),
        ("0 500 1000", "0 500", "lists of one table have 2, 3 values"),
        ("0.0 0.2 -0.1", "0.0 0,2 -0.1", "no number"),
        ("2026-03-02<", "2026-02-02<", "before it begins"),
        ("2026-03-02<", "soon<", "is not a date"),
        ("D-K-15142-01-00 2026-03", " ", "is missing"),
        ("dcc:digitalCalibrationCertificate", "dcc:other", "no Digital Calibration Certificate"),
        ("</dcc:measurementResults>", "", "not complete XML"),
        ("<dcc:administrativeData>", "<!DOCTYPE x><dcc:administrativeData>", "entities"),
    ],
)
def test_a_dcc_that_contradicts_itself_is_refused(old, new, message, tmp_path):
    assert old in LASER
    (tmp_path / "x.xml").write_text(LASER.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_dcc(tmp_path / "x.xml")


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"serial_number": "4711"}, "serial_number.*99AZ12|99AZ12.*serial_number|4711 is not in laser.xml"),
        ({"certificate_number": "other"}, "other is stated, but laser.xml has D-K-15142"),
        (
            {"certificate_sha256": "0" * 64, "certificate_number": "D-K-15142-01-00 2026-03"},
            "is stated, but laser.xml has",
        ),
        ({"certificate_file": "none.xml"}, "none.xml"),
    ],
)
def test_the_dcc_of_another_instrument_or_a_changed_one_is_refused(stated, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read_certificate(with_laser(tmp_path, **stated), complete=False)


def signed(change=lambda text: text):
    """The certificate with an enveloped signature; its canonical form is written here by hand, its file in another form."""
    canonical = LASER.partition("?>\n")[2].rstrip("\n")
    digest = base64.b64encode(hashlib.sha256(canonical.encode()).digest()).decode()
    space = "http://www.w3.org/2000/09/xmldsig#"
    signature = (
        f'<ds:Signature xmlns:ds="{space}"><ds:SignedInfo><ds:Reference URI=""><ds:Transforms>'
        f'<ds:Transform Algorithm="{space}enveloped-signature"/><ds:Transform Algorithm="http://www.w3.org/2006/12/xml-c14n11"/>'
        '</ds:Transforms><ds:DigestMethod Algorithm="http://www.w3.org/2001/04/xmlenc#sha256"/>'
        f"<ds:DigestValue>\n{digest}\n</ds:DigestValue></ds:Reference></ds:SignedInfo></ds:Signature>"
    )
    end = "</dcc:digitalCalibrationCertificate>"
    namespaces = ' xmlns:dcc="https://ptb.de/dcc" xmlns:si="https://ptb.de/si" schemaVersion="3.2.1">'
    assert namespaces in canonical
    other = "  schemaVersion='3.2.1' xmlns:si='https://ptb.de/si'\n xmlns:dcc='https://ptb.de/dcc' ><!-- a note -->"
    text = change(canonical.replace(namespaces, other)).replace(end, f"{signature}{end}")
    return f'<?xml version="1.0" encoding="UTF-8" standalone="no"?>\n{text}\n'


def test_a_signed_dcc_is_read_and_one_that_was_changed_since_is_refused(tmp_path):
    path = tmp_path / "x.xml"
    path.write_text(signed())
    assert is_unchanged(path.read_bytes()) is True
    assert read_dcc(path).numbers == ("99AZ12",)
    for old, new in (("0.0 0.2 -0.1", "0.0 0.1 -0.1"), ("Kalibrierlabor Nord", "Kalibrierlabor Sued"), (">2<", "> 2<")):
        path.write_text(signed(lambda text, old=old, new=new: text.replace(old, new)))
        with pytest.raises(InputError, match="was changed after it was signed"):
            read_dcc(path)
    assert is_unchanged(LASER.encode()) is None


@pytest.mark.parametrize(
    "content",
    [
        b"", b"x", LASER.replace("utf-8", "utf-16").encode("utf-16"), b"\x00\xff" * 50,
        LASER.replace("<dcc:items>", "<!DOCTYPE x [<!ENTITY a 'b'>]>").encode("utf-16"),
        signed(lambda text: text.replace("<dcc:items>", "<dcc:items>" + "<a>" * 5000 + "</a>" * 5000)).encode(),
    ],
)  # fmt: skip
def test_what_is_no_certificate_is_refused_whatever_it_is(content, tmp_path):
    (tmp_path / "x.xml").write_bytes(content)
    with pytest.raises(InputError):
        read_dcc(tmp_path / "x.xml")


def test_our_own_dcc_is_read_back(ran, tmp_path):
    call("report", ran, "--dcc", "examples/certificate.toml", "--out", tmp_path)
    found = read_dcc(tmp_path / "dcc.xml")
    assert found.number == "EX-2026-0117"
    assert "0001" in found.numbers
    assert found.laboratory == "Example Measuring Service"
