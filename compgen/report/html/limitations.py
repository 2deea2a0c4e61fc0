"""What the figures of a report do not say, in words, as far as it follows from what was done."""

from __future__ import annotations

from compgen.report.html.folder import ResultFolder

ALWAYS = (
    "Before and after are computed: the exact model of the machine moves with the identified errors, without and with "
    "what the files make the emulated control add. A measurement after loading is still due.",
    "Quasi-static geometric errors of three linear axes only: no thermal drift, load, dynamics, spindle or rotary axes.",
    "The figures follow published formulas of ISO 230-1 and ISO 230-2; the program is not certified against the "
    "standards.",
    "Uncertainties are expanded with k = 2. They hold the noise of the readings, and those systematic inputs that were "
    "stated.",
)


def limitations(source: ResultFolder) -> list[str]:
    """Return what the reader should not take from this report."""
    found = list(ALWAYS) if source.controls else list(ALWAYS[1:])
    identify = source.identify
    if identify.get("unobservable"):
        found.append(f"Not observable, and left at zero: {'; '.join(map(str, identify['unobservable']))}.")
    if identify and not identify.get("systematic"):
        found.append(
            "No systematic input (wavelength, temperature, target, drift) was stated; none is in the uncertainties."
        )
    if identify.get("u_length", identify.get("u_deviation", {})).get("source") == "assumed":
        found.append("The uncertainty of the readings was assumed, and scaled by the residuals.")
    for item in source.controls:
        found += [f"{item.name}: {text}" for text in item.manifest.get("unverified", [])]
        if not item.manifest:
            found.append(f"{item.name}: manifest.json is not in the folder, so settings and signs are not stated here.")
        found += [
            f"{item.name}: {f.name} is not the file that was verified (its SHA-256 differs); its verdict does not hold for it."
            for f in item.files
            if f.intact is False
        ]
    return found
