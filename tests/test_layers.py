"""The order of the layers, the rule of the simulator, and what the C++ core may not know (see ARCHITECTURE.md)."""

import ast
import importlib
import re

import pytest

import structure
from structure import LONGEST_FILE, NOT_IN_KERNELS, ROOT, without_comments

PACKAGE = ROOT / "src" / "planish"
CORE = ROOT / "src" / "core"
PYTHON_FILES = sorted(PACKAGE.rglob("*.py"))
CORE_FILES = sorted(CORE.rglob("*.[ch]pp"))
OWN_CODE = [path for folder in ("src", "tests", "benchmarks", "examples") for path in (ROOT / folder).rglob("*")]


def test_every_import_goes_to_a_lower_layer_and_the_simulator_keeps_apart():
    assert structure.layer_faults(PACKAGE) == []


def test_no_module_imports_itself_through_others():
    assert structure.import_cycles(PACKAGE) == []


def test_a_room_of_the_core_knows_itself_and_the_common_one():
    assert structure.core_faults(CORE) == []


def test_the_core_knows_neither_python_nor_files_nor_the_screen():
    assert CORE_FILES
    found = [(path.name, NOT_IN_KERNELS.findall(without_comments(path.read_text()))) for path in CORE_FILES]
    assert [item for item in found if item[1]] == []


def test_only_the_bindings_include_nanobind():
    files = (ROOT / "src").rglob("*.[ch]pp")
    including = {path.parent for path in files if "nanobind" in without_comments(path.read_text())}
    assert including == {ROOT / "src" / "bindings"}


def test_no_source_file_is_longer_than_the_limit():
    files = [path for path in OWN_CODE if path.suffix in {".py", ".pyi", ".hpp", ".cpp"}]
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert {name: length for name, length in lengths.items() if length > LONGEST_FILE} == {}


@pytest.mark.parametrize("path", PYTHON_FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_function_is_longer_than_the_limit(path):
    assert structure.long_functions(path) == []


def test_the_package_itself_holds_nothing_but_its_public_names():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    body = tree.body[1:] if ast.get_docstring(tree) else tree.body
    kinds = [type(node).__name__ for node in body if not isinstance(node, (ast.ImportFrom, ast.Assign))]
    assert kinds == []
    imported = [
        alias.asname or alias.name
        for node in body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("planish")
        for alias in node.names
    ]
    planish = importlib.import_module("planish")
    assert sorted(imported) == sorted(set(planish.__all__) - {"__version__"})
    assert [name for name in planish.__all__ if name != "__version__" and not getattr(planish, name).__doc__] == []


def make_package(root, files):
    package = root / "planish"
    for name, text in {"__init__.py": "", "errors.py": "", **files}.items():
        path = package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        (path.parent / "__init__.py").touch()
    return package


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        (
            {"rig.py": "from planish.sensing.capture import manifest", "sensing/capture/manifest.py": ""},
            "against the order",
        ),
        ({"rig.py": "def f():\n    import planish.pipeline", "pipeline.py": ""}, "against the order"),
        ({"options.py": "from . import geometry", "geometry.py": ""}, "against the order"),
        (
            {"sensing/a.py": "from ..registration.result import X", "registration/result.py": "X = 1"},
            "against the order",
        ),
        ({"simulation/a.py": "from planish.sensing import decode", "sensing/decode.py": ""}, "may not know"),
        ({"simulation/a.py": "from planish.sensing.decode import x", "sensing/decode.py": "x = 1"}, "may not know"),
        ({"simulation/a.py": "from planish.evaluation import x", "evaluation/__init__.py": "x = 1"}, "may not know"),
        ({"pipeline.py": "from planish import simulation", "simulation/__init__.py": ""}, "only the command line"),
        ({"helpers.py": "from planish import errors"}, "in no layer"),
        ({"rig.py": "from planish import Rig"}, "module that defines"),
    ],
)
def test_the_checker_finds_a_wrong_import(tmp_path, files, fault):
    faults = structure.layer_faults(make_package(tmp_path, files))
    assert len(faults) == 1
    assert fault in faults[0]


def test_the_checker_accepts_right_imports(tmp_path):
    files = {
        "_core.py": "from planish import _core_baseline",
        "sensing/capture/manifest.py": "from planish.errors import InputError\nimport numpy",
        "sensing/decode.py": "from . import capture\nfrom planish import _core",
        "simulation/scenes.py": "from planish.sensing.capture.manifest import Capture",
        "cli/simulate.py": "from planish.simulation.scenes import render",
    }
    assert structure.layer_faults(make_package(tmp_path, files)) == []


@pytest.mark.parametrize(
    ("files", "fault"),
    [
        ({"texture/chart.cpp": '#include "core/sensing/epipolar.hpp"', "sensing/epipolar.hpp": ""}, "another room"),
        ({"common/image.hpp": '#include "core/sensing/epipolar.hpp"', "sensing/epipolar.hpp": ""}, "another room"),
        ({"texture/chart.cpp": '#include "chart.hpp"', "texture/chart.hpp": ""}, "not written as"),
        ({"texture/chart.cpp": '#include "core/texture/chart.hpp"'}, "not written as"),
        ({"image.hpp": ""}, "no room"),
    ],
)
def test_the_checker_finds_a_wrong_include(tmp_path, files, fault):
    files = {"texture/blocks.cpp": '#include "core/common/range.hpp"', "common/range.hpp": "#include <span>", **files}
    for name, text in files.items():
        path = tmp_path / "core" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    faults = structure.core_faults(tmp_path / "core")
    assert len(faults) == 1
    assert fault in faults[0]


def test_the_checker_finds_a_cycle(tmp_path):
    files = {
        "sensing/a.py": "from planish.sensing import b",
        "sensing/b.py": "from planish.sensing.c import x",
        "sensing/c.py": "def f():\n    from planish.sensing import a",
    }
    package = make_package(tmp_path, files)
    assert {cycle[0] for cycle in structure.import_cycles(package)} == {"sensing.a", "sensing.b", "sensing.c"}


def test_the_checker_finds_a_long_function_but_forgives_a_long_docstring(tmp_path):
    long_body = "def f():\n" + "    x = 1\n" * 60
    long_docstring = 'def g():\n    """Say.\n' + "    more\n" * 80 + '    """\n    return 1\n'
    (tmp_path / "long.py").write_text(long_body + long_docstring)
    assert [re.sub(r".*: (\w) .*", r"\1", fault) for fault in structure.long_functions(tmp_path / "long.py")] == ["f"]


@pytest.mark.parametrize(
    "line",
    ["#include <Python.h>", "#include <nanobind/nanobind.h>", "#include <iostream>", 'std::printf("x");', "fprintf(f)"],
)
def test_the_checker_finds_what_a_kernel_may_not_hold(line):
    assert NOT_IN_KERNELS.search(without_comments(f"int a;\n{line}\n"))
    assert not NOT_IN_KERNELS.search(without_comments(f"// {line}\nint a;"))
