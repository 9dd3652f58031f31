"""Reads the structure of the source tree for test_layers.py: imports, includes, lengths."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

#: An import goes left (up in this list) only. The order of DESIGN section 3; within a layer, too, imports go one way.
LAYERS = (
    "_core", "errors", "options", "geometry", "storage",
    "rig", "measurement",
    "sensing",
    "registration",
    "evaluation",
    "simulation", "fusion",
    "files", "report",
    "execution",
    "pipeline",
    "watch", "cli",
)  # fmt: skip

#: The simulator must not share code with what it tests: of `sensing` it may know the patterns and the manifest.
SIMULATION_MAY_IMPORT = (
    "_core", "errors", "options", "geometry", "storage", "rig", "measurement",
    "sensing.patterns", "sensing.capture.manifest", "sensing.capture.board", "simulation",
)  # fmt: skip
MAY_IMPORT_SIMULATION = ("simulation", "cli")

LONGEST_FILE = 400
LONGEST_FUNCTION = 60

#: The room of `src/core` that every other room may know; else it knows only itself.
COMMON_ROOM = "common"

NOT_IN_KERNELS = re.compile(
    r"#\s*include\s*[<\"](Python\.h|nanobind/|pybind11/|iostream|fstream|sstream|cstdio|stdio\.h|print)"
    r"|\b(?:std::)?(?:v?f?printf|puts)\s*\(|\bstd::(?:cout|cerr|clog)\b"
)


@dataclass(frozen=True)
class Import:
    """Module `source` imports module `target` (dotted, without the leading `planish.`) in line `line`."""

    source: str
    target: str
    line: int


def module_name(path: Path, package: Path) -> str:
    """Return the dotted name of a file inside the package, without the package's own name ("" for its __init__)."""
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def is_module(name: str, package: Path) -> bool:
    """Return whether a dotted name inside the package is a module (compiled modules have a .pyi or a name _core_*)."""
    path = package.joinpath(*name.split("."))
    return path.is_dir() or any(path.with_suffix(end).is_file() for end in (".py", ".pyi")) or name.startswith("_core")


def imports(path: Path, package: Path) -> Iterator[Import]:
    """Yield all imports of package modules by a file, those inside functions included."""
    source = module_name(path, package)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = [package.name, *source.split(".")] if source else [package.name]
                if path.name == "__init__.py":
                    here.append("__init__")
                base = ".".join([*here[: -node.level], *([base] if base else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] != package.name:
                continue
            target = ".".join(parts[1:])
            # `from planish.rig import Rig` names an object: the module is what stands before it.
            if isinstance(node, ast.ImportFrom) and not is_module(target, package):
                target = ".".join(parts[1:-1])
            yield Import(source, target, node.lineno)


def layer_of(module: str) -> str:
    """Return the layer of a module; both builds of the core are `_core`."""
    top = module.split(".")[0]
    return "_core" if top.startswith("_core") else top


def is_inside(module: str, names: tuple[str, ...]) -> bool:
    """Return whether a module is one of `names` or lies inside one of them."""
    module = "_core" if module.startswith("_core") else module
    return any(module == name or module.startswith(name + ".") for name in names)


def layer_faults(package: Path) -> list[str]:
    """Return every import that breaks the order of the layers or the rule of the simulator, as text."""
    faults = []
    for path in sorted(package.rglob("*.py")):
        for item in imports(path, package):
            if item.source == "":
                continue  # planish/__init__.py only repeats public names
            where = f"{path.relative_to(package)}:{item.line}: {item.source} imports {item.target or package.name}"
            if item.target == "":
                faults.append(f"{where}: import from the module that defines the name")
                continue
            unknown = {layer_of(item.source), layer_of(item.target)} - set(LAYERS)
            if unknown:
                faults.append(f"{where}: {sorted(unknown)} is in no layer")
                continue
            if LAYERS.index(layer_of(item.target)) > LAYERS.index(layer_of(item.source)):
                faults.append(f"{where}: against the order of the layers")
            if is_inside(item.source, ("simulation",)) and not is_inside(item.target, SIMULATION_MAY_IMPORT):
                faults.append(f"{where}: the simulator may not know it")
            if is_inside(item.target, ("simulation",)) and not is_inside(item.source, MAY_IMPORT_SIMULATION):
                faults.append(f"{where}: only the command line, tests and benchmarks may import the simulator")
    return faults


def import_cycles(package: Path) -> list[list[str]]:
    """Return groups of modules that import each other, directly or through others."""
    files = {module_name(path, package): path for path in sorted(package.rglob("*.py"))}
    reach = {
        name: {item.target for item in imports(path, package) if item.target in files and item.target != name}
        for name, path in files.items()
    }
    for middle in files:
        for name in files:
            if middle in reach[name]:
                reach[name] |= reach[middle]
    return [[name, *sorted(reach[name])] for name in files if name in reach[name]]


def long_functions(path: Path) -> list[str]:
    """Return the functions of a file whose lines, docstring not counted, exceed the limit."""
    faults = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if ast.get_docstring(node) is not None:
                lines -= (node.body[0].end_lineno or 0) - node.body[0].lineno + 1
            if lines > LONGEST_FUNCTION:
                faults.append(f"{path.name}:{node.lineno}: {node.name} has {lines} lines")
    return faults


def without_comments(cpp: str) -> str:
    """Return C++ text with its comments blanked."""
    return re.sub(r"//[^\n]*|/\*.*?\*/", "", cpp, flags=re.DOTALL)


def core_faults(core: Path) -> list[str]:
    """Return the files outside a room of the core, and the includes that reach into another room, as text."""
    faults = []
    for path in sorted(core.rglob("*.[ch]pp")):
        name = path.relative_to(core)
        if len(name.parts) != 2:
            faults.append(f"{name}: lies in no room of the core")
            continue
        for target in re.findall(r'#\s*include\s*"([^"]+)"', without_comments(path.read_text(encoding="utf-8"))):
            parts = target.split("/")
            if len(parts) != 3 or parts[0] != core.name or not (core.parent / target).is_file():
                faults.append(f"{name}: {target} is not written as {core.name}/ROOM/NAME.hpp")
            elif parts[1] not in (name.parts[0], COMMON_ROOM):
                faults.append(f"{name}: {target} lies in another room")
    return faults
