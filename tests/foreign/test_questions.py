"""Questions about foreign files as objects: terminal, workbench and programs ask the same."""

import json

import pytest

from compgen import InputError
from compgen.app.asked import ColumnChoice, columns_shown, questions_shown, with_column, with_columns
from compgen.foreign import ImportOptions, import_file
from compgen.foreign.questions import OpenColumnsError

STRAIGHT = "X axis\nPosition [mm];Straightness Y [um]\n0;0\n100;4\n200;6\n300;0\n"


def test_the_sign_of_straightness_is_asked_with_answers_drawings_and_meanings(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text(STRAIGHT, encoding="utf-8")
    (asked,) = import_file(path).questions
    assert (asked.option, asked.picture, asked.required) == ("sign", "straightness EYX", True)
    assert [choice.value for choice in asked.choices] == ["error", "correction"]
    assert "positive: the tool is too far towards +Y (EYX)" in asked.choices[0].meaning
    assert "--" not in asked.reason
    assert asked.text.startswith(f"{asked.reason}; give --sign")
    # what the first answer says is what the numbers become: 4 um at 100 mm towards +Y
    said = {
        word: import_file(path, ImportOptions(sign=word)).data.curves["EYX"].value[1]
        for word in ("error", "correction")
    }
    assert said == pytest.approx({"error": 4e-3, "correction": -4e-3})


def test_the_page_draws_the_curve_up_where_the_answer_says_towards_plus(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text(STRAIGHT, encoding="utf-8")
    summary = import_file(path).summary()
    (shown,) = questions_shown(summary, "q", lambda word, key: ())
    titles = [answer.pictures[0].svg for answer in shown.answers]
    assert "too far towards +Y (EYX)" in titles[0]
    assert "too far towards −Y (EYX)" in titles[1]
    assert [answer.word for answer in shown.answers] == ["--sign=error", "--sign=correction"]
    # a project of an earlier version has lines alone
    (old,) = questions_shown({"doubts": ["the axis is not stated; give --axis"]}, "q", lambda word, key: ())
    assert (old.text, list(old.answers)) == ("the axis is not stated; give --axis", [])


def test_unknown_columns_are_a_question_that_the_chooser_answers(call, tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("Achse: X\nStelle;Foo\n0;0\n100;1,5\n200;2,5\n", encoding="utf-8")
    with pytest.raises(OpenColumnsError) as refused:
        import_file(path)
    assert isinstance(refused.value, InputError)
    code, out, _ = call("import", path, "--json")
    summary = json.loads(out)
    assert (code, summary["questions"][0]["option"], summary["exit_code"]) == (2, "--map", 2)
    chooser = columns_shown(path, [], summary)
    assert chooser.needed
    assert [(column.name, column.field) for column in chooser.columns] == [("Stelle", ""), ("Foo", "")]
    answers = with_column([], chooser.columns[0], "position", "mm")
    answers = with_column(answers, chooser.columns[1], "deviation", "um")
    assert answers == ["--map=position=Stelle", "--unit=position=mm", "--map=deviation=Foo", "--unit=deviation=um"]
    code, out, _ = call("import", path, *answers, "--sign=error", "--json")
    summary = json.loads(out)
    assert (code, summary["doubts"]) == (0, [])
    again = columns_shown(path, answers, summary)
    assert [column.field for column in again.columns] == ["position", "deviation"]


def test_a_column_that_is_chosen_anew_loses_what_was_said_of_it_before():
    column = ColumnChoice("Foo", "deviation", ())
    before = ["--map=deviation=Foo", "--ignore=Bar", "--axis=X"]
    assert with_column(before, column, "ignore", "") == ["--ignore=Bar", "--axis=X", "--ignore=Foo"]


def test_a_cell_without_a_number_is_named_with_its_line(tmp_path):
    path = tmp_path / "n.csv"
    path.write_text("X axis\nPosition [mm];Deviation [um]\n0;0\n100;n/a\n200;1\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"n\.csv:4: column Deviation \[um\]: 'n/a' is not a number"):
        import_file(path)


def test_columns_that_share_a_unit_are_not_given_two():
    """The unit of the last one counted for all: runs in um were read as mm."""
    place, up, down = (ColumnChoice(name, "", ()) for name in ("Ort", "a", "b"))
    given = [(place, "position", "mm"), (up, "run1+", "um"), (down, "run1-", "um")]
    assert [word for word in with_columns([], given) if word.startswith("--unit")] == [
        "--unit=position=mm",
        "--unit=deviation=um",
    ]
    with pytest.raises(InputError, match="'a' is in um and 'b' in mm; both need the same unit"):
        with_columns([], [*given[:2], (down, "run1-", "mm")])
    with pytest.raises(InputError, match="same unit"):
        with_columns([], [(up, "EAX", "urad"), (down, "EBX", "arcsec")])
    words = with_columns([], [(up, "EXX", "um"), (down, "EBX", "arcsec")])
    assert words == ["--map=EXX=a", "--unit=linear=um", "--map=EBX=b", "--unit=angle=arcsec"]
