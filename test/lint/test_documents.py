# SPDX-License-Identifier: MIT
"""What the documents name exists: links, files, commands with their options, keys, figures' commands."""
import glob
import os
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ET
from functools import lru_cache

import pytest
import yaml

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), "..", ".."))
BIN_DIR = os.environ.get("SLF_BIN_DIR", "")
TOOLS = ("fuse_bag", "simulate_drive")
DOCUMENTS = sorted(
    glob.glob(os.path.join(SOURCE_DIR, "*.md"))
    + glob.glob(os.path.join(SOURCE_DIR, "docs", "*.md"))
    + [os.path.join(SOURCE_DIR, "test", "README.md")]
)
# Tables of keys and settings, whose numbers nobody measures.
NOT_MEASURED = ("## Errors on request",)
NUMBER = r"[-+]?\d+(?: \d{3})*(?:\.\d+)?"


def text_of(path):
    with open(path, encoding="utf-8") as file:
        return file.read()


def anchors(text):
    """The anchors of a document's headings, as the usual pages make them."""
    found = set()
    for heading in re.findall(r"^#+ +(.*)$", text, re.MULTILINE):
        plain = re.sub(r"[^\w\- ]", "", heading.strip().lower())
        found.add(plain.replace(" ", "-"))
    return found


def broken_links(path, text):
    """Links to files or headings that do not exist."""
    problems = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+://|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        file = os.path.normpath(os.path.join(os.path.dirname(path), name)) if name else path
        if not os.path.exists(file):
            problems.append("no file %s" % target)
        elif anchor and anchor not in anchors(text_of(file)):
            problems.append("no heading %s" % target)
    return problems


def commands(text):
    """Command lines of the shell blocks: continued lines joined, comments left out."""
    lines = []
    for block in re.findall(r"^ *```(?:bash|sh)\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words:
                lines.append(words)
    return lines


def inline_commands(text):
    """Commands of the package that stand in a sentence: `evaluate.py a.bag --rig FILE`. What is left out
    there (...), and lists of options that are no shell words, end a command."""
    prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = []
    for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose):
        words = span.split("...")[0].split()
        if words and own_command(words):
            lines.append(words)
    return lines


def own_command(words):
    """(command of the package, its arguments); None for other programs."""
    words = list(words)
    while words and re.match(r"[A-Z_]+=", words[0]):
        words.pop(0)
    if words[:2] == ["rosrun", "semantic_lidar_fusion"]:
        words = words[2:]
    if not words:
        return None
    name = os.path.basename(words[0])
    is_own = name in TOOLS or os.path.isfile(os.path.join(SOURCE_DIR, "scripts", name))
    return (
        (name, words[1:]) if is_own and (words[0] != name or "." in name or name in TOOLS) else None
    )


@lru_cache(maxsize=None)
def help_of(name, *subcommand):
    """The text of --help; None where the program is not built."""
    if name in TOOLS:
        program = [os.path.join(BIN_DIR, name)]
        if not os.path.exists(program[0]):
            return None
    else:
        interpreter = ["bash"] if name.endswith(".sh") else [sys.executable]
        program = interpreter + [os.path.join(SOURCE_DIR, "scripts", name)]
    run = subprocess.run(
        program + list(subcommand) + ["--help"], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, "%s --help: %s" % (name, run.stderr)
    return run.stdout


@lru_cache(maxsize=None)
def rig_keys():
    """Dotted keys of a resolved rig, without those of its cameras; None without fuse_bag."""
    program = os.path.join(BIN_DIR, "fuse_bag")
    if not os.path.exists(program):
        return None
    rig = os.path.join(SOURCE_DIR, "config", "demo.yaml")
    run = subprocess.run(
        [program, "--print-rig", "--rig", rig], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    keys = set()

    def walk(prefix, value):
        keys.add(prefix)
        if isinstance(value, dict):
            for key, inner in value.items():
                walk("%s.%s" % (prefix, key) if prefix else str(key), inner)

    walk("", yaml.safe_load(run.stdout))
    return keys


def wrong_in(words):
    """What is wrong with a command line of the package, in words."""
    if words[0] == "roslaunch":
        return wrong_in_launch([word for word in words[1:] if not word.startswith("--")])
    own = own_command(words)
    if own is None:
        return []
    name, arguments = own
    text = help_of(name)
    if text is None:
        return []
    known = re.search(r"\{([\w,-]+)\}", text)
    subcommand = [a for a in arguments[:1] if known and a in known.group(1).split(",")]
    text += help_of(name, *subcommand) if subcommand else ""
    problems = []
    for option in (a.partition("=")[0] for a in arguments if re.match(r"--?[a-zA-Z]", a)):
        if not re.search(r"(?<![\w-])%s(?![\w-])" % re.escape(option), text):
            problems.append("%s has no option %s" % (name, option))
    for before, value in zip(arguments, arguments[1:]):
        key = value.partition("=")[0]
        if before != "--set" or key.startswith("cameras") or rig_keys() is None:
            continue
        if key not in rig_keys():
            problems.append("no key %s in a rig" % key)
    return problems


def wrong_in_launch(words):
    if not words or words[0] != "semantic_lidar_fusion":
        return []
    path = os.path.join(SOURCE_DIR, "launch", words[1])
    if not os.path.exists(path):
        return ["no launch file %s" % words[1]]
    known = {arg.get("name") for arg in ET.parse(path).getroot().iter("arg")}
    given = [word.partition(":=")[0] for word in words[2:] if ":=" in word]
    return ["%s has no argument %s" % (words[1], name) for name in given if name not in known]


def sections(text):
    """(heading, text) of each section."""
    parts = re.split(r"^(#+ .*)$", text, flags=re.MULTILINE)
    return [("top", parts[0])] + list(zip(parts[1::2], parts[2::2]))


def unexplained_figures(text):
    """Headings of sections with a table of figures that name no command, and lie in no section that
    does."""
    names = r"(?:\w+\.py|\w+\.sh|fuse_bag|simulate_drive|rostest|ctest|test_\w+|benchmark_\w+)"
    command = re.compile(r"(?:`[^`\n]*\b%s\b[^`\n]*`|^ *```(?:bash|sh)\n)" % names, re.MULTILINE)
    explained = {}
    problems = []
    for heading, body in sections(text):
        level = len(heading) - len(heading.lstrip("#"))
        above = any(explained.get(i, False) for i in range(level))
        explained = {i: e for i, e in explained.items() if i < level}
        explained[level] = bool(command.search(body))
        figures = re.search(r"^\|.*\|[^|\n]*\d\.\d", body, re.MULTILINE)
        if figures and not explained[level] and not above:
            problems.append(heading)
    return problems


def crowded_cells(text):
    """Cells that hold nothing but several numbers: each number wants a cell of its own."""
    unit = r" ?(?:%|[a-z-]{1,9})?"
    several = re.compile(r"[*~]*{0}{1}[*]*(?: ?[,;/(]+ ?{0}{1}\)?)+".format(NUMBER, unit))
    cells = []
    for heading, body in sections(text):
        if heading in NOT_MEASURED:
            continue
        for line in re.findall(r"^\|(.*)\| *$", body, re.MULTILINE):
            cells += [cell.strip() for cell in line.split("|") if several.fullmatch(cell.strip())]
    return cells


@pytest.mark.parametrize("path", DOCUMENTS, ids=os.path.basename)
def test_links(path):
    assert broken_links(path, text_of(path)) == []


def test_commands():
    problems = []
    for path in DOCUMENTS:
        text = text_of(path)
        for words in commands(text) + inline_commands(text):
            problems += ["%s: %s" % (os.path.basename(path), wrong) for wrong in wrong_in(words)]
    assert problems == []


def test_every_document_is_reached_from_the_readme():
    readme = text_of(os.path.join(SOURCE_DIR, "README.md"))
    for path in glob.glob(os.path.join(SOURCE_DIR, "docs", "*.md")):
        assert "(docs/%s" % os.path.basename(path) in readme, "README.md does not link it"


def test_the_readme_is_short():
    assert len(text_of(os.path.join(SOURCE_DIR, "README.md")).splitlines()) <= 200


@pytest.mark.parametrize("path", DOCUMENTS, ids=os.path.basename)
def test_figures_name_their_command(path):
    assert unexplained_figures(text_of(path)) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=os.path.basename)
def test_a_cell_holds_one_number(path):
    assert crowded_cells(text_of(path)) == []


def test_faults_are_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One\n[a](none.md) [b](#two) [c](#one)\n")
    assert broken_links(str(page), page.read_text()) == ["no file none.md", "no heading #two"]
    block = (
        "```bash\nscripts/test.sh --hurry  # ever\nroslaunch semantic_lidar_fusion no.launch\n```\n"
    )
    wrong = [problem for words in commands(block) for problem in wrong_in(words)]
    assert wrong == ["test.sh has no option --hurry", "no launch file no.launch"]
    launch = ["roslaunch", "semantic_lidar_fusion", "fusion.launch", "rigg:=a"]
    assert wrong_in(launch) == ["fusion.launch has no argument rigg"]
    if rig_keys() is not None:
        words = ["fuse_bag", "a.bag", "b.bag", "--set", "occlusion.mood=paper", "--fast"]
        assert len(wrong_in(words)) == 2
    inline = "Try `evaluate.py a.bag --hurry` and `fuse_bag ... --fast`, not `make it --fast`.\n"
    assert [wrong for words in inline_commands(inline) for wrong in wrong_in(words)] == [
        "evaluate.py has no option --hurry"
    ]
    crowd = "| 0.63 (1.74, 0) | 1.0 / 2.0 % | 3x (5x) | 1 ms, 2 ms | 0.5 | 12 344 | 1 scan | of 3, 4 |\n"
    assert len(crowded_cells(crowd)) == 4
    bare = "# Speed\n| a | b |\n|---|---|\n| x | 1.5 |\n"
    assert unexplained_figures(bare) == ["# Speed"]
    assert unexplained_figures(bare.replace("# Speed", "# Speed\n`evaluate.py a.bag`")) == []
