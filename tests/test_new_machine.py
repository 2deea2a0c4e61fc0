"""Chains from words: every usual arrangement of a machine, in English and German; and what a new machine file contains."""

import pytest

from compgen.data.machine import CHAINS, parse_machine
from compgen.data.prior import class_named
from compgen.errors import InputError
from compgen.new_machine import chains_of, in_words, machine_text, rotary_directions, usual_nodes


@pytest.mark.parametrize(
    ("words", "chain"),
    [
        # the table carries both axes, on a saddle
        ("table in X, saddle in Y, head in Z", "WXYFZT"),
        ("table moves in X on a saddle that moves in Y; spindle head in Z", "WXYFZT"),
        ("the saddle moves in X, the table moves in Y, the quill in Z", "WYXFZT"),
        ("Tisch in Y, Schlitten in X, Pinole in Z", "WYXFZT"),
        # a knee carries all three
        ("knee in Z, saddle in Y, table in X", "WXYZFT"),
        ("Konsole in Z, Sattel in Y, Tisch in X", "WXYZFT"),
        # the table carries one axis
        ("table in X, column in Y, head in Z", "WXFYZT"),
        ("Tisch fährt in X, Ständer in Y, Kopf in Z", "WXFYZT"),
        ("TISCH IN Y, QUERSCHLITTEN X, STÖßEL Z, BRÜCKE STEHT", "WYFXZT"),
        ("table in Y, fixed gantry, cross beam in Z, head in X", "WYFZXT"),
        ("column at rest, saddle in X, table in Y, head in Z", "WYXFZT"),
        # the table is at rest
        ("gantry in Y, cross slide in X, ram in Z", "WFYXZT"),
        ("fixed table, moving column in X, beam in Z, ram in Y", "WFXZYT"),
        ("Portal fährt in X, Querbalken in Z, Spindelkopf in Y", "WFXZYT"),
        ("Tisch steht, Fahrständer in X, Schlitten in Y, Pinole in Z", "WFXYZT"),
        # either may come first
        ("X: table, Y: column, Z: head", "WXFYZT"),
        ("Z by the head, Y by the column, X by the table", "WXFYZT"),
        ("wfyxzt", "WFYXZT"),
        ("W-X-Y-F-Z-T", "WXYFZT"),
    ],
)
def test_clear_words_mean_one_chain(words, chain):
    assert [item.name for item in chains_of(words)] == [chain]


@pytest.mark.parametrize(
    ("words", "likeliest", "others"),
    [
        ("table moves in X and Y, head in Z", "WXYFZT", ["WYXFZT"]),  # X on Y: as named, from the workpiece
        ("Kreuztisch in Y und X, Kopf in Z", "WYXFZT", ["WXYFZT"]),
        ("X and Y by the table, Z by the head", "WXYFZT", ["WYXFZT"]),
        ("gantry in Y, head in X and Z", "WFYXZT", ["WFYZXT"]),  # X nearer to the foundation: as named, to the tool
    ],
)
def test_axes_on_one_carriage_are_stacked_as_they_are_named(words, likeliest, others):
    found = [item.name for item in chains_of(words)]
    assert (found[0], found[1:]) == (likeliest, others)


def test_what_words_leave_open_gives_every_chain_that_they_allow():
    # an axis that is not named may be on either side, in any place
    found = {item.name for item in chains_of("table in X")}
    assert found == {name for name in CHAINS if name.index("X") < name.index("F")}
    # a slide may be on the column or below the table where both move
    assert {item.name for item in chains_of("slide in X, column in Y, table in Z")} == {"WZFYXT", "WZXFYT"}


@pytest.mark.parametrize(
    ("words", "chain"),
    [
        ("trunnion in A and C, table in Y, head in X and Z", "WCAYFXZT"),
        ("table in Y, column in X, head in Z, trunnion A, rotary table C", "WCAYFXZT"),
        ("A: trunnion, C: table, Y: table, X: column, Z: head", "WCAYFXZT"),
        ("A trunnion with B and C, the table in X and Y, a head in Z", "WCBXYFZT"),
        ("Schwenkbrücke in A, Rundtisch in C, Tisch in Y, Ständer in X, Kopf in Z", "WCAYFXZT"),
        ("table turns in C and moves in Y; column in X; head moves in Z and turns in B", "WCYFXZBT"),
        ("head in Z and B, table in X and Y. A saddle below", "WXYFZBT"),
        ("Gabelkopf in C und A, Portal in X, Querbalken in Y, Kopf in Z", "WFXYZCAT"),
        ("fork head AC, gantry in X, beam Y, ram Z", "WFXYZCAT"),
        ("table b axis, c axis; column x, beam y, head z", "WCBFXYZT"),
        ("knee in Z, saddle in Y, table in X, A axis on the table", "WAXYZFT"),
        # words that name no axis: the usual machine of the kind
        ("trunnion", "WCAYFXZT"),
        ("table and head", "WCYFXZBT"),
        ("fork head", "WXYFZCBT"),
        ("nutating head", "WCYFXZBT"),
        ("wcayfxzt", "WCAYFXZT"),
    ],
)
def test_rotary_axes_are_on_the_table_or_on_the_head_as_words_say(words, chain):
    assert chains_of(words)[0].name == chain


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("table in A, head in A and Z, table in X and Y", "A is carried by 'table' and by 'head'"),
        ("A and C", "names A, C, and not what carries it"),
        ("table in X, saddle in Y and C, head in Z", "is C an axis of the table or of the head"),
        ("WCACYFXZT", "C appears twice"),
        ("WCUYFXZT", "names no axes"),
    ],
)
def test_rotary_axes_that_words_leave_open_are_refused(words, said):
    with pytest.raises(InputError, match=said):
        chains_of(words)


def test_a_nutating_head_has_its_axis_at_45_degrees():
    for words in ("nutating head", "nutating fork head in C and B, gantry in X, beam in Y, ram in Z"):
        (letter, direction), *others = rotary_directions(words, chains_of(words)[0]).items()
        assert (letter, others) == ("B", [])
        assert direction == pytest.approx([0.0, 0.5**0.5, 0.5**0.5], abs=1e-9)
    assert rotary_directions("fork head", chains_of("fork head")[0]) == {}


@pytest.mark.parametrize("words", ["", "foo", "a big mill", "X, Y, Z"])
def test_words_without_axes_and_carriages_are_refused(words):
    with pytest.raises(InputError, match="names no axes that move"):
        chains_of(words)


def test_an_axis_on_both_sides_is_refused():
    with pytest.raises(InputError, match="X is carried by 'table' and by 'head'"):
        chains_of("table in X and Y, head in X and Z")


def test_words_of_a_chain_name_its_sides():
    assert in_words(chains_of("WFYXZT")[0]).startswith("table does not move; head moves in Z, on a carriage in X, ")
    assert in_words(chains_of("WXYZFT")[0]).endswith("on the bed; head does not move")


@pytest.mark.parametrize("name", CHAINS)
def test_the_file_of_every_chain_is_read_as_it_was_meant(name, tmp_path):
    travel = {"X": (-800.0, -100.0), "Y": (50.0, 450.5), "Z": (-10.0, 0.0)}
    text = machine_text("m", chains_of(name)[0], travel, {"X": 4, "Y": 5, "Z": 6})
    machine = parse_machine(text, tmp_path / "m.toml")
    assert (machine.name, machine.chain.name) == ("m", name)
    assert [axis.range_mm for axis in machine.axes] == list(travel.values())
    assert [len(axis.nodes_mm) for axis in machine.axes] == [4, 5, 6]
    assert machine.reference_point_mm == (-100.0, 50.0, 0.0)  # machine zero, or the end of the travel next to it


def test_every_default_that_the_file_shows_can_be_taken_as_it_is(tmp_path):
    text = machine_text("m", chains_of("WFYXZT")[0], {axis: (0.0, 500.0) for axis in "XYZ"}, dict.fromkeys("XYZ", 6))
    shown = "\n".join(line.removeprefix("# ") if " = " in line else line for line in text.splitlines())
    assert parse_machine(shown, tmp_path / "m.toml").tool_range_mm == ((0.0, 0.0), (0.0, 0.0), (-250.0, 0.0))


@pytest.mark.parametrize(
    ("travel", "nodes"), [((0.0, 100.0), 5), ((0.0, 600.0), 7), ((-1000.0, 0.0), 11), ((0.0, 5e4), 101)]
)
def test_usual_nodes_are_a_hundred_mm_apart(travel, nodes):
    assert usual_nodes(travel) == nodes


def test_the_file_states_the_class_of_the_machine(tmp_path):
    travel = {axis: (0.0, 500.0) for axis in "XYZ"}
    written = {
        name: parse_machine(
            machine_text("m", chains_of("WFYXZT")[0], travel, dict.fromkeys("XYZ", 6), (), name), tmp_path / "m.toml"
        )
        for name in (None, "precision", "router", "none")
    }
    assert {name: machine.prior.class_name for name, machine in written.items()} == {name: name for name in written}
    # angles of a machining centre 12 urad, of a router 20 times as large
    assert written[None].prior.size_um("EAX") == 12.0
    assert written["router"].prior.size_um("EAX") == 240.0


@pytest.mark.parametrize(
    ("words", "name"),
    [("Machining center", "general"), ("precision jig borer", "precision"), (" large  portal", "large"),
     ("HOBBY ROUTER", "router"), ("printer", "printer"), ("none", "none")],
)  # fmt: skip
def test_a_class_is_named_as_a_shop_says_it(words, name):
    assert class_named(words) == name


@pytest.mark.parametrize("words", ["", "mill", "generall", "0", "router printer"])
def test_other_words_are_no_class(words):
    with pytest.raises(InputError, match=r"is not a class of machines; known are precision \(precision jig borer\)"):
        class_named(words)


@pytest.mark.parametrize(
    ("line", "said"),
    [("angle_urad = 0", "angle_urad"), ("angle_urad = -3", "angle_urad"), ("angle_urad = 1e9", "is the unit that of the key"),
     ('class = "huge"', "class"), ("angles_urad = 3", "angle_urad"), ('angle_urad = "12 urad"', "angle_urad"),
     ("EXX_urad = 3", "EXX_um"), ('learn = "down"', "learn"), ("squareness_urad = nan", "squareness_urad"),
     ('class = "none"\nangle_urad = 3', "none")],
)  # fmt: skip
def test_a_prior_that_cannot_be_is_refused_with_its_key(line, said, tmp_path):
    travel = {axis: (0.0, 500.0) for axis in "XYZ"}
    text = machine_text("m", chains_of("WFYXZT")[0], travel, dict.fromkeys("XYZ", 6))
    with pytest.raises(InputError) as caught:
        parse_machine(f"{text}{line}\n", tmp_path / "m.toml")  # [prior] is the last section
    assert said in str(caught.value)
