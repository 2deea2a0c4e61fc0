"""What a reader sees of a page or a list, and what of it is English."""

import html
import re

from compgen.language import wrapped

#: Words that only an English sentence has; names and keys are taken out before.
ENGLISH = re.compile(
    r"\b(the|of|and|with|are|which|this|these|must|has|have|only|from|to|is|not|by|for|before|after)\b"
)


def numbers(text):
    """All numbers with their signs; a hyphen between letters or digits is none."""
    return re.findall(r"(?<![\w.])[-+−]?\d+(?:\.\d+)*|(?<=[^\W\d])\d+(?:\.\d+)*", text)


def left_in_english(text, sources):
    """Return the lines of a list or page that contain English words; titles of sources are names."""
    for source in sources:
        text = (
            " ".join(text.split()).replace(source, "") if "\n" not in text else text.replace(wrapped(f"- {source}"), "")
        )
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    found = []
    for piece in re.split(r"\n(?=\s*$|- |\d+\. |\||#)", text):
        plain = re.sub(
            r'`[^`]*`|"[^"]*"|„[^“]*“|\([a-z -]+\)|\S*[_/\[\]=.-]\S*\w|\bkw\.\S+', " ", " ".join(piece.split())
        )
        if ENGLISH.search(plain):
            found.append(piece)
    return found


def shown(page):
    """Return the texts of a page, without code and files."""
    body = re.sub(r"<style.*?</style>|<script.*?</script>|<code>.*?</code>|<pre.*?</pre>", "", page, flags=re.DOTALL)
    found = re.findall(r">([^<>]+)<", body) + re.findall(r'(?:title|aria-label)="([^"]*)"', body)
    return [" ".join(html.unescape(text).split()) for text in found if text.strip()]
