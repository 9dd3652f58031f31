"""The documents: links lead somewhere, tables and figures are those of the scripts, commands exist, examples import."""

import ast
import importlib
import re

import pytest

import draw_boards
import draw_conventions
import render_tables
from structure import ROOT

DOCUMENTS = list(render_tables.documents(ROOT))
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE_BLOCK = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)


def anchor(heading):
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def dead_links(path):
    text = CODE_BLOCK.sub("", path.read_text(encoding="utf-8"))
    dead = []
    for link in LINK.findall(text):
        if re.match(r"[a-z]+:", link):
            continue
        name, _, fragment = link.partition("#")
        target = path.parent / name if name else path
        if not target.exists():
            dead.append(link)
        elif fragment:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            if fragment not in map(anchor, headings):
                dead.append(link)
    return dead


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(path):
    assert dead_links(path) == []


def test_the_link_check_finds_a_dead_link_and_a_dead_anchor(tmp_path):
    (tmp_path / "b.md").write_text("# One heading: here\n")
    text = "[a](b.md) [b](c.md) ![c](b.md#one-heading-here) [d](b.md#other) [e](https://x.org) `[f](g.md)`"
    (tmp_path / "a.md").write_text(text)
    assert dead_links(tmp_path / "a.md") == ["c.md", "b.md#other"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_tables_of_a_document_are_those_of_the_saved_results(path):
    text = path.read_text(encoding="utf-8")
    assert render_tables.fill_blocks(text) == text, "run: make tables"


def test_a_table_block_is_filled_from_its_results(tmp_path):
    columns = {"scene": "scene", "rms_mm": "rms [mm]"}
    rows = [{"scene": "a|b", "rms_mm": 0.00123}, {"scene": "c", "rms_mm": None}]
    render_tables.save_table("t", columns, rows, "python b.py", {"rms_mm": ".4f"}, folder=tmp_path)
    text = render_tables.fill_blocks("x\n<!-- table: t -->\nold\n<!-- end -->\ny", tmp_path)
    assert "| scene | rms [mm] |\n|---|---|\n| a\\|b | 0.0012 |\n| c | - |\n" in text
    assert "Measured by `python b.py`" in text
    assert "old" not in text
    assert render_tables.fill_blocks(text, tmp_path) == text


def test_a_table_without_results_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="none"):
        render_tables.fill_blocks("<!-- table: none -->\n<!-- end -->", tmp_path)


def test_the_drawings_of_the_conventions_are_those_of_their_script(tmp_path):
    draw_conventions.main(tmp_path)
    for name in draw_conventions.FIGURES:
        drawn = (tmp_path / f"{name}.svg").read_text()
        assert drawn == (ROOT / "docs" / "figures" / f"{name}.svg").read_text(), "run draw_conventions.py"


def test_the_drawing_of_the_boards_is_that_of_its_script(tmp_path):
    draw_boards.main(tmp_path)
    drawn = (tmp_path / "boards.svg").read_text()
    assert drawn == (ROOT / "docs" / "figures" / "boards.svg").read_text(), "run draw_boards.py"


def test_the_commands_of_the_readme_are_targets_of_make_and_ci_runs_its_test_command():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    used = set(re.findall(r"\bmake ([\w-]+)", README))
    assert {"demo", "test"} <= used <= targets
    assert "make test" in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_objects_and_modules_of_the_architecture_exist():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    package = ROOT / "src" / "planish"
    sources = "\n".join(path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    rows = re.findall(r"^\| (`[A-Z]\w+`(?:, `[A-Z]\w+`)*) \|", text, re.MULTILINE)
    objects = [name for row in rows for name in re.findall(r"\w+", row)]
    assert len(objects) > 10
    assert [name for name in objects if f"class {name}:" not in sources and f"class {name}(" not in sources] == []
    modules = re.findall(r"`([a-z_/]+/[a-z_]*\.py|[a-z_]+\.py|[a-z_/]+/)`", text)
    places = (package, ROOT)
    missing = [name for name in modules if not any((place / name).exists() for place in places)]
    assert [name for name in missing if not name.startswith("tests/")] == []


def test_the_python_of_the_readme_uses_public_names():
    pytest.importorskip("planish.pipeline")
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    imports = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    names = [(node.module, alias.name) for node in imports for alias in node.names if "planish" in (node.module or "")]
    assert names
    assert [name for module, name in names if name not in importlib.import_module(module).__all__] == []
