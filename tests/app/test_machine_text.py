"""Keys of a machine file are changed in its text: whatever TOML allows stays valid, and everything else stays as it is."""

import tomllib

import pytest

from compgen.app.machine_text import with_section, with_value
from compgen.errors import InputError

MULTI_LINE = """\
[controllers.mach4]
nodes_mm = [  # ten
    0.0,
    100.0,  # not [200]
]
sign = "error"  # as measured
"""
BLANKS = """\
# [ controllers.mach4 ] is what this file is for
[ controllers.mach4 ]   # the mill
sign = "error"
"""
QUOTED = """\
[controllers."mach4"]
"sign" = 'error'
note = "a # is no comment"
"""
APART = """\
[controllers.mach4]
sign = "error"

[prior]
class = "general"

[controllers.pmac]
counts = 1
"""
DOTTED = 'controllers.mach4.sign = "error"\nname = "m"\n'
INLINE = 'controllers = { mach4 = { sign = "error" } }\n'
TEXTS = """\
note = \"\"\"
[controllers.mach4]
sign = "old"
# [controllers.mach4]
\"\"\"
[controllers.mach4]
sign = "error"
"""
WHOLE = [MULTI_LINE, BLANKS, QUOTED, APART, DOTTED, INLINE, TEXTS]


def expected(text, *, key, value, section=("controllers", "mach4")):
    data = tomllib.loads(text)
    table = data
    for part in section:
        table = table.setdefault(part, {})
    if value is None:
        table.pop(key)
    else:
        table[key] = value
    return data


@pytest.mark.parametrize("text", WHOLE)
@pytest.mark.parametrize("key", ["sign", "digits"])
def test_a_value_is_set_in_every_form_that_toml_allows(text, key):
    changed = with_value(text, "controllers.mach4", key, '"correction"')
    assert tomllib.loads(changed) == expected(text, key=key, value="correction")
    assert changed.count("#") == text.count("#")
    before, after = text.splitlines(), changed.splitlines()
    assert len([line for line in before if line not in after]) == (0 if text != INLINE and key == "digits" else 1)


@pytest.mark.parametrize("text", WHOLE)
def test_a_value_is_unset_in_every_form(text):
    changed = with_value(text, "controllers.mach4", "sign", "")
    assert tomllib.loads(changed) == expected(text, key="sign", value=None)


def test_an_array_over_several_lines_is_replaced_whole_and_unset_whole():
    changed = with_value(MULTI_LINE, "controllers.mach4", "nodes_mm", "[1.0, 2.0]")
    assert tomllib.loads(changed)["controllers"]["mach4"] == {"nodes_mm": [1.0, 2.0], "sign": "error"}
    unset = with_value(MULTI_LINE, "controllers.mach4", "nodes_mm", "")
    assert unset == MULTI_LINE.replace("nodes_mm", "# nodes_mm").replace("    ", "#     ").replace(
        "]\nsign", "# ]\nsign"
    )


def test_a_key_that_stands_in_a_comment_is_used_where_it_stands():
    text = 'name = "m"\n# [controllers.mach4]\n# digits = 3                              # decimals\n'
    text += '# sign = "error"\n\n# [controllers.pmac]\n# digits = 1\n'
    changed = with_value(text, "controllers.mach4", "digits", "4")
    assert changed == text.replace("# [controllers.mach4]\n# digits = 3 ", "[controllers.mach4]\ndigits = 4   ")
    added = with_value(text, "controllers.mach4", "unknown", "1")
    assert added == text.replace("# [controllers.mach4]", "[controllers.mach4]").replace(
        '# sign = "error"\n', '# sign = "error"\nunknown = 1\n'
    )


def test_a_comment_whose_section_would_take_keys_of_another_one_stays_a_comment():
    text = "[machine]\n# [controllers.mach4]\nx = 1\n"
    changed = with_value(text, "controllers.mach4", "digits", "4")
    assert changed == text + "\n[controllers.mach4]\ndigits = 4\n"


def test_a_section_is_added_once():
    text = with_section('name = "m"\n', "controllers.mach4")
    assert text == 'name = "m"\n\n[controllers.mach4]\n'
    assert with_section(text, "controllers.mach4") == text
    assert with_section(BLANKS, "controllers.mach4") == BLANKS


def test_a_value_that_toml_cannot_read_is_refused_by_its_name():
    with pytest.raises(InputError, match="'1,5' is no TOML value") as caught:
        with_value(MULTI_LINE, "controllers.mach4", "digits", "1,5")
    assert caught.value.field == "controllers.mach4.digits"
    with pytest.raises(InputError, match="is no TOML value"):
        with_value(MULTI_LINE, "controllers.mach4", "digits", "1\nsign = 2")
