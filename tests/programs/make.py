"""Random programs of all moves, in the words that all dialects share or those of LinuxCNC, with their set-up."""

import numpy as np

from machines import machine_of

OFFSETS_MM = {"G54": (12.7, -25.4, -50.8), "G55": (-25.4, 50.8, -38.1)}
TOOLS_MM = {"1": (0.0, 0.0, 25.4), "2": (0.0, 0.0, 76.2)}


def mill():
    """A machine with room on all sides."""
    return machine_of([(-600.0, 600.0), (-500.0, 500.0), (-400.0, 200.0)], 9, tool_offset_mm=(0.0, 0.0, -50.0))


def random_program(seed, count=60, *, linuxcnc=True, cycles=True):
    """Blocks of a random program within 100 mm of the work offset: lines, arcs in all planes and forms, cycles, offsets."""
    r = np.random.default_rng(seed)
    lines = ["%", "G21 G90 G17 G54 G94 G40 G49", "T1 M6", "G43 H1", "G0 X0.0 Y0.0 Z20.0", "G1 X1.0 F500"]
    at, inch, absolute, plane = np.array([1.0, 0.0, 20.0]), False, True, 2
    digits, size = 3, 40.0

    def word(letter, value):
        return f"{letter}{value:.{digits}f}"

    def place():
        return np.round(r.uniform(-1, 1, 3) * size, digits)

    def go(codes, end, words, extra=""):
        nonlocal at
        values = end if absolute else end - at
        text = " ".join([*codes, *(word("XYZ"[k], values[k]) for k in words)])
        lines.append(f"{text}{extra}")
        at = np.round(np.where(np.isin(np.arange(3), words), end, at), digits)

    for number in range(count):
        kind = r.integers(0, 12)
        head = [f"N{number * 10}"] if r.random() < 0.3 else []
        if kind < 4:
            words = sorted(r.choice(3, r.integers(1, 4), replace=False))
            code = [["G0"], ["G1"], ["g01"], ["G1"]][kind]
            go([*head, *code], place(), words, " (comment)" if r.random() < 0.2 else "")
        elif kind < 8:
            a, b = ((1, 2), (2, 0), (0, 1))[plane]
            centre = np.round(r.uniform(-1, 1, 3) * size / 2, digits) + at
            radius = np.hypot(*(at - centre)[[a, b]])
            if radius < size / 20:
                continue
            start = np.arctan2((at - centre)[b], (at - centre)[a])
            ccw = r.random() < 0.5
            full = r.random() < 0.2
            turn = 2 * np.pi if full else r.uniform(0.2, 6.0)
            angle = start + (turn if ccw else -turn)
            end = at.copy()
            if not full:
                end[a], end[b] = centre[a] + radius * np.cos(angle), centre[b] + radius * np.sin(angle)
            if r.random() < 0.3:
                end[plane] = at[plane] + r.uniform(-3, 3)
            end = np.round(end, digits)
            words = sorted({a, b} | ({plane} if end[plane] != at[plane] else set()))
            code = "G3" if ccw else "G2"
            if r.random() < 0.3 and not full and abs(turn - np.pi) > 0.5 and turn < 5.5:
                more = f" {word('R', radius if turn < np.pi else -radius)}"
            else:
                offset = centre - at
                more = f" {word('IJK'[a], offset[a])} {word('IJK'[b], offset[b])}"
            if full and r.random() < 0.5:
                words = [plane] if plane in words else []
            if linuxcnc and full and r.random() < 0.3:
                more += " P2"
            go([*head, code], end, words, more)
        elif kind == 8:
            plane = int(r.integers(0, 3))
            lines.append(["G19", "G18", "G17"][plane])
        elif kind == 9:
            absolute = not absolute
            lines.append("G90" if absolute else "G91")
        elif kind == 10 and linuxcnc:
            inch = not inch
            factor = 1 / 25.4 if inch else 25.4
            digits, size = (4, 40 / 25.4) if inch else (3, 40.0)
            lines.append("G20" if inch else "G21")
            if not absolute:
                absolute = True
                lines.append("G90")
            at = at * factor
            go(["G0"], place(), [0, 1, 2])
        elif kind == 11 and absolute and plane == 2:
            choice = r.integers(0, 4)
            if choice == 0:
                lines.append(["G54", "G55"][r.integers(0, 2)])
                go(["G0"], place(), [0, 1, 2])
            elif choice == 1 and linuxcnc:
                tool = r.integers(1, 3)
                lines.append(f"G43 H{tool}")
                go(["G0"], place(), [0, 1, 2])
            elif choice == 2 and cycles:
                low, high = np.round(np.array([-0.9, -0.5]) * size, digits)
                cycle = ["G81", "G82", "G85", "G83", "G73"][r.integers(0, 5)]
                extra = f" {word('Q', size / 17)}" if cycle in ("G83", "G73") else " P0.1" if cycle == "G82" else ""
                level = ["G98", "G99"][r.integers(0, 2)]
                go(["G0"], np.array([0, 0, round(size / 2, digits)]), [0, 1, 2])
                first, second = place(), place()
                lines.append(
                    f"{level} {cycle} {word('X', first[0])} {word('Y', first[1])} {word('Z', low)} {word('R', high)}{extra}"
                )
                lines.append(f"{word('X', second[0])}")
                lines.append("G80")
                go(["G0"], place(), [0, 1, 2])
            elif linuxcnc:
                go(["G1"], place(), [0, 1, 2])
                lines.append(f"G92 {word('X', at[0] + size / 10)}")
                at[0] = round(at[0] + size / 10, digits)
                go(["G1"], at + size / 20, [0, 1])
                lines.append("G92.1")
                go(["G0"], place(), [0, 1, 2])
    return "\n".join([*lines, "M2", "%", ""])
