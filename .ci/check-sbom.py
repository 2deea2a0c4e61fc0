"""Checks the bill of materials in a wheel against the schema of CycloneDX, and puts a copy beside the wheel."""

import json
import sys
import zipfile
from pathlib import Path

from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

wheel = Path(sys.argv[1])
with zipfile.ZipFile(wheel) as archive:
    (name,) = (name for name in archive.namelist() if ".dist-info/sboms/" in name)
    text = archive.read(name).decode()
if problem := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text):
    sys.exit(f"{name}: {problem}")
bill = json.loads(text)
own = bill["metadata"]["component"]
if own["version"] != wheel.name.split("-")[1]:
    sys.exit(f"{name} is of version {own['version']}: run make sbom")
copy = wheel.with_name(f"{own['name']}-{own['version']}.cdx.json")
copy.write_text(text)
print(f"{name}: valid CycloneDX {bill['specVersion']}, {len(bill['components'])} components; copy: {copy}")
