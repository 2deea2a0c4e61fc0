"""Random programs of all moves, in the words that all dialects share or those of LinuxCNC, with their set-up."""

import numpy as np

from compgen.programs.dialects import DIALECTS
from machines import machine_of

OFFSETS_MM = {"G54": (12.7, -25.4, -50.8), "G55": (-25.4, 50.8, -38.1)}
TOOLS_MM = {"1": (0.0, 0.0, 25.4), "2": (0.0, 0.0, 76.2)}


#: Dialects whose blocks are words of a letter and a number.
G_CODE = [name for name in DIALECTS if name != "heidenhain-klartext"]


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


def mixed_program(seed, dialect, count=400):
    """Blocks as CAM systems mix them: lines, arcs in all forms and planes, increments, M codes, comments, holes."""
    r = np.random.default_rng(seed)
    heidenhain, siemens, fanuc = (dialect == name for name in ("heidenhain-iso", "siemens", "fanuc"))
    inch = seed % 5 == 4 and not heidenhain
    units = {"siemens": "G70" if inch else "G71", "heidenhain-iso": "G90"}.get(dialect, "G20" if inch else "G21")
    size, most = (2.0, 4) if inch else (50.0, 3)
    head = {"fanuc": ["%", "O7"], "heidenhain-iso": ["%P G71"], "siemens": ["%_N_P_MPF"]}.get(dialect, [])
    end = {"fanuc": ["M30", "%"], "heidenhain-iso": ["N9999 %P G71"]}.get(dialect, ["M30"])
    lines = [f"{units} G90 G17" if heidenhain else f"{units} G90 G17 G54", "G0 X0. Y0. Z0."]
    at, absolute, plane, motion, relative = np.zeros(3), True, 2, 0, True
    closing = "*" if heidenhain else ""

    def word(letter, value):
        nonlocal plus
        text = f"{value:.{digits}f}"
        if short and "." in text:
            text = text.rstrip("0")
            text = text if fanuc or r.random() < 0.5 else text.rstrip(".") or "0"
        text = "0." if text in ("-0.", "-0", "") else text
        return letter + ("+" if plus and text[0] != "-" else "") + text

    while len(lines) < count:
        digits, short, plus = int(r.integers(max(most - 2, 1), most + 3)), r.random() < 0.4, r.random() < 0.3
        kind, codes, more = r.random(), [f"N{10 * len(lines)}"] if r.random() < 0.4 else [], ""
        if kind < 0.05:
            said = {"siemens": "; MSG (a) X5", "heidenhain-iso": "; X5 *"}.get(dialect, "(tool X5 ; [1])")
            lines.append(
                r.choice([said, "M8", "M3 S900", "", "F300", "N5 M9", "G64" if dialect != "heidenhain-iso" else "G40"])
            )
            continue
        if 0.91 < kind < 0.93 and absolute and plane == 2 and dialect in ("linuxcnc", "fanuc"):
            low, digits, short = -size / 2, most, False
            cycle = r.choice(
                ["G81", "G82 P1", "G83 Q" + f"{size / 25:.{digits}f}", "G85", "G73 Q" + f"{size / 25:.{digits}f}"]
            )
            lines.append(
                f"{r.choice(['G98', 'G99'])} {cycle} {word('Z', low)} {word('R', size / 5)} {word('X', at[0])}"
            )
            for _ in range(int(r.integers(2, 25))):
                at[:2] = np.round(np.where(r.random(2) < 0.8, r.uniform(-size, size, 2), at[:2]), digits)
                names = [word("XY"[k], at[k]) for k in range(2) if r.random() < 0.9]
                names += [word("Z", low + r.uniform(0, size / 5))] if r.random() < 0.1 or not names else []
                names += [word("R", size * r.uniform(-0.1, 0.2))] if r.random() < 0.1 else []
                lines.append("".join(names))
            at = np.round(r.uniform(-size, size, 3), digits)
            lines += ["G80", " ".join(["G0", *(word("XYZ"[k], at[k]) for k in range(3))])]
            motion = 0
            continue
        if kind < 0.07:
            plane = int(r.integers(0, 3))
            codes.append(["G19", "G18", "G17"][plane])
        if kind > 0.94:
            absolute = not absolute
            codes.append("G90" if absolute else "G91")
        if dialect == "linuxcnc" and 0.93 < kind < 0.94:
            relative = not relative
            lines.append("G91.1" if relative else "G90.1")
        target = np.clip(at + r.normal(0, size / 8, 3), -size, size)
        if kind < 0.6 or kind > 0.9:
            words = sorted(r.choice(3, r.integers(1, 4), replace=False))
            if motion not in (0, 1) or r.random() < 0.3:
                motion = int(r.random() < 0.8)
                codes.append(r.choice([f"G{motion}", f"G0{motion}"]))
        else:
            a, b = ((1, 2), (2, 0), (0, 1))[plane]
            centre = at + r.normal(0, size / 8, 3)
            arm = (at - centre)[[a, b]]
            if np.hypot(*arm) < size / 50:
                continue
            ccw, full = bool(r.random() < 0.5), r.random() < 0.15
            turn = (1 if ccw else -1) * (2 * np.pi if full else r.uniform(0.05, 6.0))
            c, s = np.cos(turn), np.sin(turn)
            target = np.array(at)
            if not full:
                target[a], target[b] = centre[a] + c * arm[0] - s * arm[1], centre[b] + s * arm[0] + c * arm[1]
            words = [] if full and r.random() < 0.5 else [a, b]
            if r.random() < 0.3 or (heidenhain and not words):
                words = [*words, plane]
                target[plane] = at[plane] + r.normal(0, size / 50)
            words, digits = sorted(words), 6 if full else max(digits, most)
            if motion != 2 + ccw or r.random() < 0.3:
                motion = 2 + ccw
                codes.append(f"G{motion}")
            target = np.where(np.isin(np.arange(3), words), at + np.round(target - at, digits), at)
            if (
                not full
                and not heidenhain
                and r.random() < 0.3
                and 0.3 < abs(turn) < 5.5
                and abs(abs(turn) - np.pi) > 0.5
            ):
                radius = np.hypot(*arm) * (1 if abs(turn) < np.pi else -1)
                more = word("CR=" if siemens else "R", radius)
            else:
                base = at if relative and not heidenhain else 0.0 * at
                if heidenhain and not absolute:
                    base = at
                values = np.round(centre - base, digits)
                more = " ".join(word("IJK"[k], values[k]) for k in (a, b))
                if heidenhain and r.random() < 0.4:
                    lines.append(more + closing)
                    more = ""
            if dialect == "linuxcnc" and r.random() < 0.1:
                more += " P2"
        values = np.round(target if absolute else target - at, digits)
        parts = [
            *codes,
            *(word("XYZ"[k], values[k]) for k in words),
            *more.split(),
            *(["F500"] if r.random() < 0.1 else []),
        ]
        block = ("" if r.random() < 0.3 else " ").join(parts)
        block = block.lower() if r.random() < 0.1 and not siemens else block
        comment = {"siemens": " ; c", "heidenhain-iso": ""}.get(dialect, " (c)")
        lines.append(block + (comment if r.random() < 0.1 else "") + closing)
        if r.random() < 0.05:
            lines[-1] = lines[-1].replace("*", "") + (" M8" if r.random() < 0.5 else " M9") + closing
        at = np.where(np.isin(np.arange(3), words), values if absolute else at + values, at)
    return "\n".join([*head, *lines, "G90 G0 X0. Y0. Z0." + closing, *end, ""])


def random_holes(seed, count=40):
    """Series of holes of LinuxCNC with all that may change within them: shifts, offsets, lengths, levels, increments, repeats."""
    r = np.random.default_rng(seed)
    inch = bool(r.random() < 0.3)
    unit, digits = (25.4, 4) if inch else (1.0, 3)
    lines = ["%", f"{'G20' if inch else 'G21'} G90 G17 G54 G94 G40 G49", "T1 M6", "G43", "G0 X0 Y0 Z0 F300"]

    def word(letter, low, high):
        return f"{letter}{r.uniform(low, high) / unit:.{digits}f}"

    def one(*choices):
        return choices[r.integers(0, len(choices))]

    def place(size=40):
        return f"{word('X', -size, size)} {word('Y', -size, size)}"

    def change():
        """What may stand between two holes, or in the block of the next."""
        return [
            lambda: f"G52 {word(one('X', 'Y'), -8, 8)} {word('Z', -8, 8)}",
            lambda: f"G92 {word('Z', 20, 60)}",
            lambda: "G92.1",
            lambda: f"{one('G54', 'G55')} {place()}",
            lambda: f"{one('G54', 'G55')}\n{place()}",
            lambda: f"G43 H{one(1, 2)} {place()}",
            lambda: one(f"G43.1 {word('Z', 10, 90)}", "G49"),
            lambda: one("G98", "G99"),
            lambda: f"{word('X', -40, 40)} {word('R', 10, 30)}",
        ][r.integers(0, 9)]()

    for _ in range(count // 8):
        if r.random() < 0.4:
            lines.append(one("T1 M6 G43", "G43 M6 T2", "G43 H1 T2 M6", "M6 T1\nG43"))
        lines += [f"G0 {place()} {word('Z', 20, 60)}", "S900 M3"]
        cycle = one("G81", "G82", "G83", "G73", "G85", "G86", "G89")
        extra = f" {word('Q', 4, 9)}" if cycle in ("G83", "G73") else "" if cycle in ("G81", "G85") else " P0.1"
        lines.append(f"{one('G98', 'G99')} {cycle} {place()} {word('Z', -20, 5)} {word('R', 10, 30)}{extra}")
        for _ in range(r.integers(2, 7)):
            lines.append(one(place(), word("X", -40, 40), f"{word('Y', -40, 40)} L2"))
            if r.random() < 0.7:
                lines.append(change())
        if r.random() < 0.4:
            lines.append("G99")
            lines.append(f"G91 {word('X', -5, 5)} {word('R', -20, -10)} {word('Z', -9, -3)} L{one(1, 2, 3)}")
            lines.append(
                one(f"G52 {word('Z', -5, 5)} {word('X', -5, 5)}", f"G92 {word('Z', 20, 40)}", "G43 H2", "G98", "")
            )
            lines.append(place(3))
            lines.append(f"G90 {place()} {word('Z', -20, 5)} {word('R', 10, 30)}")
        lines.append(one("G80", f"G0 {place()}"))
    return "\n".join([*lines, "G80", "G92.1", "G0 X0 Y0", "M2", "%", ""])
