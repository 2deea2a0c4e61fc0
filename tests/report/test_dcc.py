"""The Digital Calibration Certificate: form by PTB's published schema, numbers by the files, nothing of its own making.

Validity against the schema itself is tested where ``COMPGEN_DCC_SCHEMA`` names one or more ``dcc.xsd``; the schema is
PTB's and does not come with the tests. The order of elements below is written down from its documentation.
"""

import datetime
import json
import os
import re
import shutil
import socket
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.files import json_values
from compgen.errors import InputError
from compgen.report.dcc import certificate_files, certificate_xml, read_certificate, read_schema
from compgen.report.dcc.laboratory import CONDITIONS
from compgen.report.dcc.xml import local_copy
from compgen.report.html.folder import read_folder
from compgen.report.html.write import content

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "certificate.toml"
N = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
SCHEMAS = [path for path in os.environ.get("COMPGEN_DCC_SCHEMA", "").split(os.pathsep) if path]
needs_schema = pytest.mark.skipif(
    not SCHEMAS, reason="COMPGEN_DCC_SCHEMA names no dcc.xsd (PTB's schema is not part of compgen)"
)
#: Parts of D-SI units that may occur.
UNIT_PARTS = {"micro", "milli", "hecto", "metre", "radian", "degreeCelsius", "percent", "pascal"}

#: Children in the order of the schema, release 3.3.0; those of one line may be absent but not stand elsewhere.
ORDER = {
    "dcc:digitalCalibrationCertificate": "administrativeData measurementResults comment document",
    "dcc:administrativeData": "dccSoftware refTypeDefinitions coreData items calibrationLaboratory respPersons customer "
    "statements",
    "dcc:coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier identifications "
    "receiptDate beginPerformanceDate endPerformanceDate performanceLocation issueDate",
    "dcc:item": "name equipmentClass description owner installedSoftwares manufacturer model identifications",
    "dcc:measuringEquipment": "name equipmentClass description certificate manufacturer model identifications",
    "dcc:identification": "issuer value name",
    "dcc:respPerson": "person description role mainSigner",
    "dcc:contact": "name eMail phone fax link location",
    "dcc:statement": "name description countryCodeISO3166_1 convention traceable norm reference link declaration",
    "dcc:measurementResult": "name description usedMethods usedSoftware measuringEquipments influenceConditions results "
    "measurementMetaData",
    "dcc:usedMethod": "name description norm reference",
    "dcc:influenceCondition": "name description status certificate data",
    "dcc:result": "name description data",
    "dcc:quantity": "name description real realListXMLList",
    "si:real": "label value unit measurementUncertaintyUnivariate",
    "si:realListXMLList": "labelXMLList valueXMLList unitXMLList measurementUncertaintyUnivariateXMLList",
    "si:expandedMU": "valueExpandedMU coverageFactor coverageProbability distribution",
    "si:expandedMUXMLList": "valueExpandedMUXMLList coverageFactorXMLList coverageProbabilityXMLList distributionXMLList",
}
MANDATORY = {
    "dcc:administrativeData": "dccSoftware coreData items calibrationLaboratory respPersons customer",
    "dcc:coreData": "countryCodeISO3166_1 usedLangCodeISO639_1 mandatoryLangCodeISO639_1 uniqueIdentifier "
    "beginPerformanceDate endPerformanceDate performanceLocation",
    "dcc:item": "name identifications",
    "dcc:measurementResult": "name results",
    "dcc:result": "name data",
    "si:real": "value unit",
    "si:realListXMLList": "valueXMLList unitXMLList",
}


def call(*words):
    return run_command(cli, [str(word) for word in words])


def numbers_of(folder):
    return json_values(content(read_folder(folder)))


def parsed(document):
    return ElementTree.fromstring(document)


def name_of(element):
    namespace, _, tag = element.tag[1:].partition("}")
    return f"{ {uri: prefix for prefix, uri in N.items()}[namespace] }:{tag}"


def named(root, start):
    """The first result whose name begins with ``start``."""
    found = [
        r for r in root.iterfind(".//dcc:result", N) if r.findtext("dcc:name/dcc:content", "", N).startswith(start)
    ]
    assert found, start
    return found[0]


def floats(element, path):
    text = element.findtext(path, namespaces=N)
    assert text is not None, path
    return [float(word) for word in text.split(" ")]


def halved_errors(text):
    """An errors file with half of every value."""
    return re.sub(r"(?m)^(E\w\w\w?,[^,]*,)([^,]+)", lambda row: f"{row[1]}{float(row[2]) / 2:.9f}", text)


@pytest.fixture(scope="module")
def folders(small_machine_file, small_lengths_file, tmp_path_factory):
    """Results of run (two controls), identify, accuracy, compare, compare --predicted and verify."""
    base = tmp_path_factory.mktemp("dcc")
    names = ("run", "identify", "accuracy", "compare", "predicted", "verify")
    run, identify, accuracy, compare, predicted, verify = (base / name for name in names)
    tables = ["--controller", "isg-csv", "--controller", "siemens-cec", "--no-report"]
    assert call("run", small_machine_file, small_lengths_file, *tables, "--out", run) == 0
    assert call("identify", small_machine_file, small_lengths_file, "--out", identify) == 0
    errors = identify / "identified.errors.csv"
    assert call("accuracy", small_machine_file, errors, "--out", accuracy) == 0
    halved = base / "after.errors.csv"
    halved.write_text(halved_errors(errors.read_text()))
    assert call("compare", small_machine_file, errors, halved, "--out", compare) == 0
    assert call("compare", small_machine_file, errors, errors, "--predicted", "--out", predicted) == 0
    files = [
        run / "isg-csv" / item["name"] for item in json.loads((run / "isg-csv" / "result.json").read_text())["files"]
    ]
    words = [*files, "--controller", "isg-csv", "--errors", errors, "--out", verify]
    assert call("verify", small_machine_file, *words) == 0
    return {path.name: path for path in (run, identify, accuracy, compare, predicted, verify)}


@pytest.fixture(scope="module")
def numbers(folders):
    return {name: numbers_of(path) for name, path in folders.items()}


@pytest.fixture(scope="module")
def options():
    return read_certificate(EXAMPLE)


@pytest.fixture(scope="module")
def document(numbers, options):
    return certificate_xml(numbers["run"], options)


@pytest.fixture(scope="module")
def root(document):
    return parsed(document)


# --- form --------------------------------------------------------------------------------------------------------


def test_the_root_names_namespace_release_and_schema(root, document):
    assert document.startswith(b'<?xml version="1.0" encoding="UTF-8"?>\n<dcc:digitalCalibrationCertificate ')
    assert root.tag == "{https://ptb.de/dcc}digitalCalibrationCertificate"
    assert root.get("schemaVersion") == "3.3.0"
    location = root.get("{http://www.w3.org/2001/XMLSchema-instance}schemaLocation")
    assert location == "https://ptb.de/dcc https://ptb.de/dcc/v3.3.0/dcc.xsd"


def test_only_elements_of_the_two_namespaces_occur(root):
    assert {element.tag.partition("}")[0][1:] for element in root.iter()} == set(N.values())


@pytest.mark.parametrize("kind", ["run", "identify", "accuracy", "compare"])
def test_elements_stand_in_the_order_of_the_schema(numbers, options, kind):
    seen = set()
    for element in parsed(certificate_xml(numbers[kind], options)).iter():
        name = name_of(element)
        children = [child.tag.partition("}")[2] for child in element]
        if name in ORDER:
            seen.add(name)
            order = ORDER[name].split()
            assert set(children) <= set(order), name
            assert children == sorted(children, key=order.index), name
        assert set(MANDATORY.get(name, "").split()) <= set(children), name
    assert seen == set(ORDER) - (
        set() if kind in ("run", "identify") else {"si:expandedMUXMLList", "si:realListXMLList"}
    )


def test_texts_of_the_program_say_their_language_and_it_is_declared(root):
    assert [item.text for item in root.iterfind(".//dcc:usedLangCodeISO639_1", N)] == ["en"]
    assert {item.get("lang") for item in root.iterfind(".//dcc:content", N)} == {"en", None}


def test_every_ref_type_is_of_a_declared_namespace_and_none_turns_the_sign(root):
    declared = {item.text for item in root.iterfind(".//dcc:refTypeDefinition/dcc:namespace", N)}
    used = {word for element in root.iter() for word in element.get("refType", "").split()}
    assert {"basic_measuredValue", "basic_nominalValue", "iso230_EXX", "iso230_EC0Y"} <= used
    assert {word.partition("_")[0] for word in used} == declared
    # an indication minus a reference is commanded minus actual, the opposite of ISO 230-1
    assert "basic_measurementError" not in used


def test_units_are_in_the_notation_of_the_d_si(root):
    units = [element.text for tag in ("unit", "unitXMLList") for element in root.iterfind(f".//si:{tag}", N)]
    assert {"\\micro\\metre", "\\micro\\radian", "\\milli\\metre", "\\degreeCelsius"} <= set(units)
    for unit in units:
        assert re.fullmatch(r"(\\[a-zA-Z]+)+", unit)
        assert set(unit.split("\\")[1:]) <= UNIT_PARTS


def test_lists_have_one_blank_between_their_entries_and_as_many_uncertainties_as_values(root):
    lists = root.findall(".//si:realListXMLList", N)
    assert len(lists) > 20
    for item in lists:
        words = item.findtext("si:valueXMLList", "", N)
        assert re.fullmatch(r"\S+( \S+)*", words)
        uncertainties = item.find(".//si:valueExpandedMUXMLList", N)
        assert uncertainties is None or len(uncertainties.text.split(" ")) == len(words.split(" "))


# --- numbers -----------------------------------------------------------------------------------------------------


def test_errors_have_the_values_signs_and_expanded_uncertainties_of_the_errors_file(root, folders):
    """EXX of +3 um in identified.errors.csv is +3 um here: actual minus commanded, never turned around."""
    table = compgen.read_errors(folders["run"] / "identified.errors.csv")
    assert len(table.curves) > 10
    for name, curve in table.curves.items():
        position, value = named(root, f"{name}:").findall(".//si:realListXMLList", N)
        scale = 1e3 if name[1] in "XYZ" else 1e6
        assert floats(position, "si:valueXMLList") == pytest.approx(curve.position_mm.tolist(), rel=1e-12)
        assert floats(value, "si:valueXMLList") == pytest.approx((curve.value * scale).tolist(), rel=1e-12)
        expanded = floats(value, ".//si:valueExpandedMUXMLList")
        assert expanded == pytest.approx((2.0 * scale * curve.u).tolist(), rel=1e-12)
        unit = "\\micro\\metre" if name[1] in "XYZ" else "\\micro\\radian"
        assert (position.findtext("si:unitXMLList", "", N), value.findtext("si:unitXMLList", "", N)) == (
            "\\milli\\metre",
            unit,
        )
        assert np.any(np.array(floats(value, "si:valueXMLList")) < 0) == bool(np.any(curve.value < 0))


def test_squareness_is_a_single_value_with_its_uncertainty(root, folders):
    table = compgen.read_errors(folders["run"] / "identified.errors.csv")
    assert set(table.squareness) == {"EC0Y", "EB0Z", "EA0Z"}
    for name, (value, u) in table.squareness.items():
        real = named(root, f"{name}:").find(".//si:real", N)
        assert floats(real, "si:value") == pytest.approx([1e6 * value], rel=1e-12)
        assert floats(real, ".//si:valueExpandedMU") == pytest.approx([2e6 * u], rel=1e-12)
        assert real.findtext("si:unit", "", N) == "\\micro\\radian"


def test_every_uncertainty_says_k_2_and_its_probability(root):
    """95.45 % is the share of a normal distribution within two standard deviations, erf(sqrt 2)."""
    for suffix in ("", "XMLList"):
        factors = {item.text for item in root.iterfind(f".//si:coverageFactor{suffix}", N)}
        shares = {item.text for item in root.iterfind(f".//si:coverageProbability{suffix}", N)}
        words = {item.text for item in root.iterfind(f".//si:distribution{suffix}", N)}
        assert (factors, shares, words) == ({"2.0"}, {"0.9545"}, {"normal"})


def test_the_numbers_are_those_of_calibration_json_digit_by_digit(folders, tmp_path):
    assert call("report", folders["run"], "--out", tmp_path, "--dcc", EXAMPLE) == 0
    root = ElementTree.parse(tmp_path / "dcc.xml").getroot()
    errors, *verifications = json.loads((tmp_path / "calibration.json").read_text())["measurementResults"]
    for item in errors["results"]:
        result = named(root, f"{item['name']}:")
        path = ".//si:valueXMLList" if item["positions"]["valueXMLList"] else ".//si:value"
        texts = [element.text.split(" ") for element in result.iterfind(path, N)]
        assert texts[-1] == [repr(value) for value in item["values"]["valueXMLList"]]
    computed = [
        result
        for result in root.iterfind(".//dcc:measurementResult", N)
        if result.findtext("dcc:name/dcc:content", "", N).endswith(", computed")
    ]
    assert len(computed) == len(verifications) == 2
    for item, result in zip(verifications, computed, strict=True):
        for when in ("before", "after"):
            found = [text.text for text in named(result, when).iterfind(".//si:value", N)]
            assert found == [repr(row["value"]) for row in item["results"] if row["when"] == when]


def test_figures_of_iso_230_are_those_of_the_report(root, numbers):
    for group in numbers["run"]["accuracy"]["groups"]:
        quantities = named(root, group["name"]).findall(".//dcc:quantity", N)
        found = {
            q.findtext("dcc:name/dcc:content", "", N): (floats(q, ".//si:value"), floats(q, ".//si:valueExpandedMU"))
            for q in quantities
        }
        assert found == {row["key"]: ([row["value"]], [row["U"]]) for row in group["rows"]}


def test_before_and_after_of_a_comparison_have_their_own_values(numbers, options):
    root = parsed(certificate_xml(numbers["compare"], options))
    rows = {row["key"]: row for row in numbers["compare"]["compare"]["groups"][0]["rows"]}
    for when in ("before", "after"):
        quantities = named(root, f"Volume (ISO 230-1), {when}").findall(".//dcc:quantity", N)
        found = {q.findtext("dcc:name/dcc:content", "", N): floats(q, ".//si:value")[0] for q in quantities}
        assert found == {key: row[when] for key, row in rows.items()}
    assert rows["V_X"]["after"] == pytest.approx(0.5 * rows["V_X"]["before"], rel=1e-3)


def test_what_is_computed_says_so_and_carries_no_uncertainty(root):
    results = root.findall(".//dcc:measurementResult", N)
    names = [item.findtext("dcc:name/dcc:content", "", N) for item in results]
    assert [name.endswith("computed") for name in names] == [False, False, True, True]
    for item in results[2:]:
        assert "computed and not measured" in item.findtext(
            "dcc:usedMethods/dcc:usedMethod/dcc:name/dcc:content", "", N
        )
        results = item.find("dcc:results", N)
        assert results.find(".//si:measurementUncertaintyUnivariate", N) is None
        assert results.find(".//si:real", N) is not None


def test_input_files_stand_there_with_their_hashes(root, numbers):
    texts = " ".join(item.text for item in root.iterfind(".//dcc:metaData/dcc:declaration/dcc:content", N))
    inputs = numbers["run"]["provenance"]["inputs"]
    assert len(inputs) == 2
    assert all(f"{item['name']}, SHA-256 {item['sha256']}" in texts for item in inputs)


@pytest.mark.parametrize(
    "method", ["joint", "two-step", "deviations", "axis-runs", "sixdof", "merged", "given", "new", None]
)
def test_the_method_of_the_identification_is_named(numbers, options, method):
    data = {**numbers["identify"], "measurement": {"method": method}}
    text = parsed(certificate_xml(data, options)).findtext(".//dcc:usedMethod/dcc:description/dcc:content", "", N)
    assert (text.startswith("Method ") and (method or "not stated") in text) == (method in ("new", None))


# --- what the laboratory stated ----------------------------------------------------------------------------------


def test_administrative_data_are_those_of_the_laboratory(root):
    core = root.find(".//dcc:coreData", N)
    assert {child.tag.partition("}")[2]: child.text for child in core} == {
        "countryCodeISO3166_1": "DE",
        "usedLangCodeISO639_1": "en",
        "mandatoryLangCodeISO639_1": "en",
        "uniqueIdentifier": "EX-2026-0117",
        "receiptDate": "2026-11-03",
        "beginPerformanceDate": "2026-11-09",
        "endPerformanceDate": "2026-11-10",
        "performanceLocation": "customer",
        "issueDate": "2026-11-12",
    }
    items = root.findall(".//dcc:item", N)
    assert [item.findtext("dcc:name/dcc:content", "", N) for item in items] == ["small-gantry", "Example control"]
    assert [item.findtext(".//dcc:identification/dcc:value", "", N) for item in items] == ["0001", "0002"]
    assert root.findtext(".//dcc:customer/dcc:location/dcc:countryCode", "", N) == "AT"
    assert root.findtext(".//dcc:respPerson/dcc:mainSigner", "", N) == "true"


def test_statements_say_what_it_is_not_and_which_sign_it_has(root):
    found = {
        item.findtext("dcc:name/dcc:content", "", N): item.findtext("dcc:declaration/dcc:content", "", N)
        for item in root.iterfind(".//dcc:statement", N)
    }
    assert "not a calibration laboratory" in found["What this document is not"]
    assert "actual minus commanded" in found["Sign convention"]
    assert found["Traceability"].startswith("The instruments are calibrated")
    convention = root.findtext(".//dcc:statement/dcc:convention", "", N)
    assert convention == "actual minus commanded, tool relative to workpiece"


def test_conditions_are_those_stated_with_lowest_and_highest_value(root):
    condition = root.find(".//dcc:influenceCondition[@refType='basic_temperature']", N)
    values = {q.get("refType"): floats(q, "si:real/si:value") for q in condition.iterfind(".//dcc:quantity", N)}
    assert values == {"basic_temperatureMin": [19.6], "basic_temperatureMax": [20.4]}
    humidity = root.find(".//dcc:quantity[@refType='basic_humidityRelative']", N)
    assert (floats(humidity, "si:real/si:value"), humidity.findtext("si:real/si:unit", "", N)) == ([45.0], "\\percent")


def without(text, first, last=None):
    """The example without the lines from the one that starts with ``first`` up to ``last``."""
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(first))
    stop = start + 1 if last is None else next(k for k in range(start + 1, len(lines)) if lines[k].startswith(last))
    return "\n".join(lines[:start] + lines[stop:])


def written(tmp_path, text):
    path = tmp_path / "certificate.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_conditions_that_nobody_stated_are_not_made_up(numbers, tmp_path):
    text = without(EXAMPLE.read_text(), "[conditions]", "[[statement]]")
    root = parsed(certificate_xml(numbers["run"], read_certificate(written(tmp_path, text))))
    conditions = root.findall(".//dcc:influenceCondition", N)
    assert len(conditions) == len(root.findall(".//dcc:measurementResult", N))
    assert {item.findtext(".//dcc:text/dcc:content", "", N) for item in conditions} == {
        "The conditions during the measurement were not stated."
    }


def test_temperatures_of_the_scales_come_from_the_readings(numbers, options):
    notes = {"expansion_um_per_m_k": 11.0, "mean_c": 22.0, "lowest_c": 21.5, "highest_c": 22.25}
    data = {**numbers["run"], "measurement": {"corrections": {"temperature": {"Y": notes}}}}
    root = parsed(certificate_xml(data, options))
    found = [
        item
        for item in root.iterfind(".//dcc:influenceCondition", N)
        if "Y scale" in item.findtext("dcc:name/dcc:content", "", N)
    ]
    assert [floats(q, "si:real/si:value") for q in found[0].iterfind(".//dcc:quantity", N)] == [[21.5], [22.25]]


KEYS = [
    ("[certificate]", "number"),
    ("[certificate]", "country"),
    ("[certificate]", "begin"),
    ("[certificate]", "end"),
    ("[certificate]", "location"),
    ("[laboratory]", "name"),
    ("[laboratory]", "city"),
    ("[laboratory]", "country"),
    ("[customer]", "name"),
    ("[customer]", "city"),
    ("[customer]", "country"),
    ("[[person]]", "name"),
    ("[machine]", "manufacturer"),
    ("[machine]", "serial_number"),
    ("[control]", "name"),
    ("[control]", "serial_number"),
    ("[[equipment]]", "name"),
    ("[[equipment]]", "serial_number"),
    ("[[statement]]", "name"),
    ("[[statement]]", "text"),
]


@pytest.mark.parametrize(("section", "key"), KEYS)
def test_a_mandatory_key_that_is_missing_is_named_and_never_filled_in(section, key, tmp_path):
    head, _, tail = EXAMPLE.read_text().partition(section)
    path = written(tmp_path, head + section + without(tail, f"{key} ="))
    with pytest.raises(InputError) as caught:
        read_certificate(path)
    assert caught.value.field == f"[{section.strip('[]')}] {key}"
    assert "missing" in caught.value.message


@pytest.mark.parametrize("section", ["certificate", "laboratory", "customer", "machine", "person", "equipment"])
def test_a_mandatory_section_that_is_missing_is_named(section, tmp_path):
    parts = re.split(r"(?m)^(?=\[)", EXAMPLE.read_text())
    kept = [part for part in parts if not re.match(rf"\[+{section}\]", part)]
    assert len(kept) == len(parts) - 1
    with pytest.raises(InputError, match=f"{section}.*missing"):
        read_certificate(written(tmp_path, "".join(kept)))


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("begin = 2026-11-09", 'begin = "2026-11-09"', "a date"),
        ("begin = 2026-11-09", "begin = 2026-11-09T10:00:00", "a date"),
        ("end = 2026-11-10", "end = 2026-11-08", "before begin"),
        ("received = 2026-11-03", "received = 2026-11-11", "after the end"),
        ("issued = 2026-11-12", "issued = 2026-11-01", "before the end"),
        ('country = "DE" ', 'country = "Germany" ', "two capital letters"),
        ('location = "customer"', 'location = "shopfloor"', "'laboratory', 'customer'"),
        ('number = "EX-2026-0117"', 'number = "  "', "one line of text"),
        ("main_signer = true", 'main_signer = "yes"', "true or false"),
        ("air_temperature_c = [19.6, 20.4]", "air_temperature_c = [20.4, 19.6]", "[lowest, highest]"),
        ("air_temperature_c = [19.6, 20.4]", "air_temperature_c = 293.15", "from -60 to 100"),
        ("humidity_percent = 45", "humidity_percent = [40, 45, 50]", "two numbers"),
        ("humidity_percent = 45", "humidity = 45", "humidity_percent"),
        ('code = "EX-1"', 'acreditation = "EX-1"', "not a known key"),
        ("[control] ", "[controls] ", "not a known key"),
        ("certificate_number =", "certificate_sha256 =", "64 hexadecimal digits"),
        ('certificate_number = "EX-2026-0003"', f'certificate_sha256 = "{"a" * 64}"', "needs certificate_number"),
    ],
)
def test_a_wrong_entry_is_refused_with_what_is_expected(before, after, said, tmp_path):
    text = EXAMPLE.read_text()
    assert text.count(before) >= 1
    with pytest.raises(InputError) as caught:
        read_certificate(written(tmp_path, text.replace(before, after, 1)))
    assert said in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_the_example_uses_every_condition_and_reads_as_it_stands(options):
    assert len(options.conditions) == len(CONDITIONS)
    assert (options.begin, options.end) == (datetime.date(2026, 11, 9), datetime.date(2026, 11, 10))
    assert options.equipment[0].certificate_number == "EX-2026-0003"


def test_the_hash_of_an_instruments_certificate_stands_with_it(numbers, tmp_path):
    text = EXAMPLE.read_text().replace(
        "certificate_number =", f'certificate_sha256 = "{"AB" * 32}"\ncertificate_number ='
    )
    root = parsed(certificate_xml(numbers["run"], read_certificate(written(tmp_path, text))))
    certificate = root.find(".//dcc:measuringEquipment/dcc:certificate", N)
    found = {child.tag.partition("}")[2]: child.text for child in certificate if child.text and child.text.strip()}
    assert found == {"referralID": "EX-2026-0003", "procedure": "SHA-256", "value": "ab" * 32}


# --- hostile texts -----------------------------------------------------------------------------------------------

HOSTILE = "</dcc:name><script>alert(1)</script> &xxe; &lt; ]]> <!-- <?pi?> \"'"


def document_with(text, numbers, tmp_path):
    """A certificate with ``text`` wherever a user or a file can put one."""
    quoted = text.replace('"', '\\"')
    toml = EXAMPLE.read_text().replace("Example Works", quoted).replace('name = "Traceability"', f'name = "{quoted}"')
    data = {**numbers["run"], "title": text, "limitations": [text]}
    data["provenance"] = {**data["provenance"], "inputs": [{"name": text, "sha256": text}]}
    return certificate_xml(data, read_certificate(written(tmp_path, toml)))


def test_markup_and_entities_in_texts_of_the_user_are_inert(numbers, tmp_path):
    document = document_with(HOSTILE, numbers, tmp_path)
    root = parsed(document)
    assert root.findtext(".//dcc:customer/dcc:name/dcc:content", "", N) == HOSTILE
    assert root.findtext(".//dcc:item/dcc:name/dcc:content", "", N) == HOSTILE
    harmless = parsed(document_with("harmless", numbers, tmp_path))
    assert [element.tag for element in root.iter()] == [element.tag for element in harmless.iter()]
    for forbidden in (b"<script", b"&xxe;", b"<!--", b"<?pi", b"<!DOCTYPE", b"<!ENTITY"):
        assert forbidden not in document


@pytest.mark.parametrize("bad", ["\x00", "\x0b", "\x1f", "\ud800", "\ufffe", "\uffff"])
def test_characters_that_xml_does_not_know_are_replaced(numbers, options, bad):
    data = {**numbers["run"], "title": f"a{bad}b"}
    root = parsed(certificate_xml(data, options))
    assert root.findtext(".//dcc:item/dcc:name/dcc:content", "", N) in ("a\ufffdb", "a b")


def test_texts_keep_letters_of_all_scripts(numbers, options):
    data = {**numbers["run"], "title": "Fräsmaschine Ω 机床 \U0001f527"}
    document = certificate_xml(data, options)
    assert parsed(document).findtext(".//dcc:item/dcc:name/dcc:content", "", N) == "Fräsmaschine Ω 机床 \U0001f527"
    assert "Fräsmaschine".encode() in document


# --- releases and refusals ---------------------------------------------------------------------------------------


def test_the_older_release_has_the_older_form_of_the_uncertainty_with_the_same_numbers(numbers, options, root):
    older = parsed(certificate_xml(numbers["run"], options, "3.2.1"))
    assert older.get("schemaVersion") == "3.2.1"
    assert older.find(".//si:measurementUncertaintyUnivariateXMLList", N) is None
    values = named(older, "EXX:").findall(".//si:realListXMLList", N)[1]
    children = [child.tag.partition("}")[2] for child in values.find("si:expandedUncXMLList", N)]
    assert children == [
        "uncertaintyXMLList",
        *(f"{name}XMLList" for name in ("coverageFactor", "coverageProbability", "distribution")),
    ]
    newer = named(root, "EXX:").find(".//si:valueExpandedMUXMLList", N)
    assert values.findtext(".//si:uncertaintyXMLList", "", N) == newer.text
    single = named(older, "EC0Y:").find(".//si:real/si:expandedUnc", N)
    assert [child.tag.partition("}")[2] for child in single][0] == "uncertainty"


def test_other_releases_are_refused(numbers, options):
    with pytest.raises(InputError, match="not supported; use 3.2.1 or 3.3.0"):
        certificate_xml(numbers["run"], options, "3.1.2")


@pytest.mark.parametrize("kind", ["predicted", "verify"])
def test_a_folder_in_which_nothing_was_measured_gets_no_certificate(numbers, options, kind):
    with pytest.raises(InputError, match="nothing to certify"):
        certificate_xml(numbers[kind], options)


# --- the check against a schema ----------------------------------------------------------------------------------

#: A schema of the same name, release and imports as PTB's that asks for little: enough to see how it is found and obeyed.
SMALL_SCHEMA = """\
<xs:schema version="{version}" xmlns:xs="http://www.w3.org/2001/XMLSchema" xmlns:dcc="{namespace}"
    xmlns:si="https://ptb.de/si" targetNamespace="{namespace}" elementFormDefault="qualified">
  <xs:import namespace="https://ptb.de/si" schemaLocation="{imported}"/>
  <xs:element name="digitalCalibrationCertificate"><xs:complexType>
    <xs:sequence><xs:any processContents="skip" minOccurs="2" maxOccurs="{most}"/></xs:sequence>
    <xs:attribute name="schemaVersion" type="si:release" use="required"/>
  </xs:complexType></xs:element>
</xs:schema>
"""
SMALL_UNITS = """\
<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="https://ptb.de/si">
  <xs:simpleType name="release"><xs:restriction base="xs:string"><xs:pattern value="[0-9.]+"/></xs:restriction></xs:simpleType>
</xs:schema>
"""
ADDRESS = "https://ptb.de/si/v2.2.1/SI_Format.xsd"


def small_schema(folder, *, version="3.3.0", imported=ADDRESS, units="SI_Format.xsd", namespace=N["dcc"], most=2):
    folder.mkdir(parents=True, exist_ok=True)
    values = {"version": version, "imported": imported, "namespace": namespace, "most": most}
    (folder / "dcc.xsd").write_text(SMALL_SCHEMA.format(**values))
    if units:
        (folder / units).parent.mkdir(parents=True, exist_ok=True)
        (folder / units).write_text(SMALL_UNITS)
    return folder / "dcc.xsd"


@pytest.fixture
def no_network(monkeypatch):
    """Fail at every attempt to look up a host or to connect."""

    def refuse(*words, **_):
        raise AssertionError(f"network: {words}")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.mark.parametrize("units", ["SI_Format.xsd", "v2.2.1/SI_Format.xsd", "si/v2.2.1/SI_Format.xsd"])
def test_an_import_with_a_web_address_is_found_on_the_disk(units, document, tmp_path, no_network):
    schema = read_schema(small_schema(tmp_path, units=units))
    assert schema.version == "3.3.0"
    assert schema.faults(document) == []


def test_the_longest_end_of_the_path_wins_and_dots_lead_nowhere(tmp_path):
    for place in ("SI_Format.xsd", "v2.2.1/SI_Format.xsd"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_text(SMALL_UNITS)
    assert local_copy(ADDRESS, tmp_path) == (tmp_path / "v2.2.1" / "SI_Format.xsd").as_uri()
    assert local_copy("https://ptb.de/../../SI_Format.xsd", tmp_path) == (tmp_path / "SI_Format.xsd").as_uri()
    assert local_copy("https://ptb.de/other.xsd", tmp_path) == "https://ptb.de/other.xsd"
    assert local_copy("../dsi.xsd", tmp_path) == "../dsi.xsd"


def test_an_import_that_is_not_on_the_disk_is_named_and_not_fetched(tmp_path, no_network):
    with pytest.raises(InputError, match=r"SI_Format\.xsd.*put the schemas that it imports into its folder"):
        read_schema(small_schema(tmp_path, units=None))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": "3.0.0"}, "release 3.0.0 of the DCC schema is not supported; use 3.2.1 or 3.3.0"),
        ({"namespace": "https://example.org/other"}, "describes https://example.org/other"),
    ],
)
def test_another_schema_is_refused(changes, said, tmp_path):
    path = small_schema(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        read_schema(path)
    assert said in caught.value.message
    assert caught.value.file == path


@pytest.mark.parametrize("text", ["", "no xml", "<a/>"])
def test_what_is_no_schema_is_refused(text, tmp_path):
    path = tmp_path / "dcc.xsd"
    path.write_text(text)
    with pytest.raises(InputError, match="cannot be used as a schema"):
        read_schema(path)
    with pytest.raises(InputError, match="no such file"):
        read_schema(tmp_path / "missing.xsd")


def test_the_release_of_the_schema_decides_which_one_is_written(numbers, options, tmp_path):
    schema = read_schema(small_schema(tmp_path, version="3.2.1"))
    root = parsed(certificate_files(numbers["run"], options, schema)["dcc.xml"])
    assert root.get("schemaVersion") == "3.2.1"


def test_a_document_that_is_not_valid_is_not_written_and_nothing_else_either(folders, tmp_path, listing, capsys):
    schema = small_schema(tmp_path / "schema", most=3)
    text = schema.read_text().replace('minOccurs="2"', 'minOccurs="3"')
    schema.write_text(text)
    folder = Path(shutil.copytree(folders["run"], tmp_path / "run"))
    before = listing(folder)
    assert call("report", folder, "--dcc", EXAMPLE, "--dcc-schema", schema) == 2
    assert "is not valid by this schema and was not written" in capsys.readouterr().err
    assert listing(folder) == before


def test_report_uses_the_certificate_toml_of_the_folder_and_says_that_it_was_not_checked(folders, tmp_path, capsys):
    folder = Path(shutil.copytree(folders["identify"], tmp_path / "identify"))
    shutil.copy(EXAMPLE, folder / "certificate.toml")
    assert call("report", folder) == 0
    assert "not checked against the schema" in capsys.readouterr().out
    assert ElementTree.parse(folder / "dcc.xml").getroot().get("schemaVersion") == "3.3.0"


def test_report_says_which_schema_a_document_is_valid_by(folders, tmp_path, capsys):
    schema = small_schema(tmp_path / "schema")
    out = tmp_path / "out"
    assert call("report", folders["identify"], "--out", out, "--dcc", EXAMPLE, "--dcc-schema", schema) == 0
    assert f"dcc.xml: DCC 3.3.0, valid against {schema}" in capsys.readouterr().out
    assert (out / "dcc.xml").is_file()


def test_a_schema_without_a_certificate_is_refused(folders, tmp_path, capsys):
    schema = small_schema(tmp_path)
    assert call("report", folders["identify"], "--out", tmp_path / "out", "--dcc-schema", schema) == 2
    assert "--dcc certificate.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_without_a_certificate_toml_no_certificate_is_written(folders, tmp_path):
    assert call("report", folders["identify"], "--out", tmp_path / "out") == 0
    assert not (tmp_path / "out" / "dcc.xml").exists()


# --- PTB's schema ------------------------------------------------------------------------------------------------


@needs_schema
@pytest.mark.parametrize("path", SCHEMAS)
@pytest.mark.parametrize("kind", ["run", "identify", "accuracy", "compare"])
def test_certificates_are_valid_by_the_schema_of_ptb(path, kind, numbers, options, no_network):
    schema = read_schema(path)
    assert schema.faults(certificate_xml(numbers[kind], options, schema.version)) == []


@needs_schema
@pytest.mark.parametrize("path", SCHEMAS)
def test_a_certificate_with_the_least_that_is_asked_for_is_valid_too(path, numbers, tmp_path):
    text = EXAMPLE.read_text()
    for first, last in (("[control]", "[[equipment]]"), ("[conditions]", "[[statement]]")):
        text = without(text, first, last)
    text = text.partition("[[statement]]")[0]
    for key in (
        "received",
        "issued",
        "code",
        "street",
        "street_number",
        "post_code",
        "email",
        "role",
        "main_signer",
        "model",
    ):
        text = without(text, f"{key} =")
    schema = read_schema(path)
    options = read_certificate(written(tmp_path, text))
    assert options.control is None
    assert schema.faults(certificate_xml(numbers["run"], options, schema.version)) == []


@needs_schema
@pytest.mark.parametrize("path", SCHEMAS)
@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"2026-11-10</dcc:endPerformanceDate>", b"10.11.2026</dcc:endPerformanceDate>"),
        (b"<dcc:issuer>manufacturer<", b"<dcc:issuer>maker<"),
        (b">2.0</si:coverageFactor>", b">0.5</si:coverageFactor>"),
        (b"<si:unit>", b"<si:quantity/><si:unit>"),
        (b"<dcc:performanceLocation>customer</dcc:performanceLocation>", b""),
        (b"<dcc:uniqueIdentifier>EX-2026-0117", b"<dcc:uniqueIdentifier> EX-2026-0117"),
    ],
)
def test_the_schema_of_ptb_finds_a_single_fault(path, before, after, numbers, options):
    schema = read_schema(path)
    document = certificate_xml(numbers["run"], options, schema.version)
    assert document.count(before) >= 1
    assert len(schema.faults(document.replace(before, after, 1))) >= 1
