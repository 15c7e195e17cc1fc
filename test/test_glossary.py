"""The package keeps to the words of docs/glossary.md, in its names and in its texts."""

import ast
import io
import re
import tokenize
from pathlib import Path

import omsm_ros

PACKAGE = Path(omsm_ros.__file__).parent
ROOT = PACKAGE.parent
# Pages of the reference are generated from the code, whose texts are tested above.
WRITTEN = [p for p in sorted((ROOT / "docs").rglob("*.md")) if p.parent.name != "reference"]
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")


def _rows(heading):
    section = GLOSSARY.split(heading)[1].split("\n## ")[0]
    rows = [line.strip("| \n").split(" | ") for line in section.splitlines() if line[:2] == "| "]
    return [row for row in rows[1:] if not row[0].startswith("--")]


FORBIDDEN = [word for row in _rows("## Words that are not used") for word in row[0].split(", ")]
# A degree of freedom is a term; a freedom alone is not.
PATTERN = re.compile(
    r"(?<!degree of )(?<!degrees of )\b(" + "|".join(map(re.escape, FORBIDDEN)) + r")\b",
    re.IGNORECASE,
)
# Words that users set: `mount: carriage` of the vibration monitor stays readable in their files.
SET_BY_USERS = {("core/ripple/accelerometer.py", "carriage")}


def _parted(name):
    return re.sub(r"([a-z])([A-Z])", r"\1 \2", name).replace("_", " ")


def forbidden_words(source):
    """Yield (line, word) of forbidden words in names, comments, docstrings and texts."""
    if not (PATTERN.search(source) or PATTERN.search(_parted(source))):
        return  # without its tokens, which take longer
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME:
            words = _parted(token.string)
        elif token.type in (tokenize.COMMENT, tokenize.STRING):
            words = token.string
        else:
            continue
        for match in PATTERN.finditer(words):
            yield token.start[0], match[1]


def test_the_glossary_has_terms_in_order():
    terms = [row[0].lower() for row in _rows("# Glossary")]
    assert len(terms) > 40
    assert len(set(terms)) == len(terms)


def test_modules_use_no_forbidden_word():
    modules = {p.relative_to(PACKAGE).as_posix(): p for p in PACKAGE.rglob("*.py")}
    assert len(modules) > 200
    found = [
        (module, line, word)
        for module, path in modules.items()
        for line, word in forbidden_words(path.read_text(encoding="utf-8"))
    ]
    assert not [one for one in found if (one[0], one[2]) not in SET_BY_USERS]


def test_pages_use_no_forbidden_word():
    found = []
    for page in (ROOT / "README.md", *WRITTEN):
        text = page.read_text(encoding="utf-8")
        if page.name == "glossary.md":
            text = text.split("## Words that are not used")[0]
        found += [(page.name, m[1]) for m in PATTERN.finditer(" ".join(text.split()))]
    assert len(WRITTEN) > 10
    assert not found


def test_a_forbidden_word_is_found_wherever_it_stands():
    ways = ("{} = 1\n", "# It is {}.\n", '"""It is {}."""\n')
    sources = [ways[0].format(word.replace(" ", "_")) for word in FORBIDDEN]
    assert all(ast.parse(source) for source in sources)
    sources += [way.format(word) for word in FORBIDDEN for way in ways[1:]]
    assert len(FORBIDDEN) > 20
    assert not [source for source in sources if not list(forbidden_words(source))]
