"""The whole chain from Python: tracer lengths in, a checked table out (python examples/quickstart.py)."""

import tempfile
from pathlib import Path

import compgen

machine = compgen.load_machine("zha-gantry")
lengths = compgen.read_lengths(Path(__file__).parent / "zha-gantry.lengths.csv")
identified = compgen.identify(machine, lengths)
fitted = compgen.fit(machine, identified.errors)
exported = compgen.export(machine, fitted.errors, "isg-csv")
with tempfile.TemporaryDirectory() as folder:
    paths = exported.write(folder)  # volcomp0.csv, volcomp0.lis, manifest.json, preflight.md
    tables = compgen.read_tables(machine, paths, "isg-csv")  # parses the text that was written
    result = compgen.verify(machine, tables, identified.errors)

print(f"EC0Y {identified.errors.squareness['EC0Y'][0] * 1e6:.1f} urad, chi2 {identified.reduced_chi_square:.3f}")
print(f"before {result.before.max_um:.1f} um, after {result.after.max_um:.2f} um, accepted: {result.accepted}")
