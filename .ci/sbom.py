"""Writes compgen/sbom.cdx.json, the bill of materials that comes with the wheel, from the pinned requirements: make sbom.

CycloneDX 1.6: compgen, the packages that it and its extras need (also indirectly), and which needs which. What only builds
or tests compgen is not part of it. It has no time and no random number, so that the same pins give the same file.
"""

import json
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Sources that come with compgen and run elsewhere, under a licence of their own.
SHIPPED = {"volkins": "templates/linuxcnc-volumetric/volkins.comp"}


def normal(name):
    """Return the name of a package as an index writes it."""
    return re.sub("[-_.]+", "-", name).lower()


def pins(file):
    """Return version and markers of each package of a requirements file, and the packages that ask for it."""
    found, name = {}, ""
    for line in (ROOT / file).read_text().splitlines():
        if entry := re.match(r"([A-Za-z0-9._-]+)(?:\[.*\])?==([^ ;]+)(?: ; ([^\\]+))?", line):
            name = normal(entry[1])
            found.setdefault(name, []).append((entry[2], (entry[3] or "").strip(), set()))
        elif asked := re.match(r" +#(?: via)? +([A-Za-z0-9._-]+)(?: \((.*)\))?$", line):
            found[name][-1][2].add((normal(asked[1]), asked[2] or ""))
    return found


def run_time(found):
    """Return the packages that compgen needs to run: those that it asks for, and what they ask for."""
    needed, before = {"compgen"}, set()
    while needed != before:
        before = set(needed)
        needed |= {name for name, rows in found.items() for _, _, by in rows if {one for one, _ in by} & needed}
    return needed - {"compgen"}


def bill():
    """Return the bill of materials."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = re.search(r'VERSION = "(.+)"', (ROOT / "compgen/resources.py").read_text())[1]
    base, every = pins("requirements.txt"), pins("requirements-extras.txt")
    # those of the basic installation are constraints of the other file, which repeats what the extras need of them
    known = {name: base.get(name, []) + [row for row in rows if name not in base] for name, rows in {**every, **base}.items()}
    for name, rows in every.items():
        if name in base:
            known[name][0][2].update(rows[0][2])
    required = run_time(base)
    root = f"pkg:pypi/compgen@{version}"
    parts, needs = [], {root: set()}
    refs = {}
    for name in sorted(run_time(known)):
        for number, markers, _ in known[name]:
            refs.setdefault(name, []).append(f"pkg:pypi/{name}@{number}")
            part = {"type": "library", "bom-ref": refs[name][-1], "name": name, "version": number, "purl": refs[name][-1]}
            part["scope"] = "required" if name in required else "optional"
            if markers:
                part["properties"] = [{"name": "compgen:marker", "value": markers}]
            parts.append(part)
            needs.setdefault(refs[name][-1], set())
    for name, own in refs.items():
        for _, _, by in known[name]:
            for asking, _ in by:
                for ref in [root] if asking == "compgen" else refs.get(asking, []):
                    needs[ref].update(own)
    for name, path in SHIPPED.items():
        licence = re.search(r"SPDX-License-Identifier: (\S+)|license \"GPL\"", (ROOT / path).read_text())
        parts.append({"type": "file", "bom-ref": name, "name": path, "licenses": [{"license": {"id": "GPL-2.0-or-later"}}]})
        needs[root].add(name)
        assert licence, path
    own = {"type": "application", "bom-ref": root, "name": "compgen", "version": version, "purl": root}
    own |= {"description": project["description"], "licenses": [{"expression": project["license"]}]}
    return {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": own},
        "components": parts,
        "dependencies": [{"ref": ref, "dependsOn": sorted(others)} for ref, others in sorted(needs.items())],
    }


if __name__ == "__main__":
    text = json.dumps(bill(), indent=1) + "\n"
    (ROOT / "compgen" / "sbom.cdx.json").write_text(text)
    print(f"compgen/sbom.cdx.json: {len(bill()['components'])} components")
